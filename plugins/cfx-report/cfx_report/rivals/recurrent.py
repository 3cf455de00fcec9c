"""Recurrent networks that set the acceleration themselves, trained by rollout.

Shapes: P pairs, h hidden size.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cfx_report.benchmark.rival import Seen
from cfx_report.rivals.rollout_training import (
    FEATURES,
    NetworkDriver,
    RolloutRival,
    acceleration_of,
    features_of,
)


class _Cell(nn.Module):
    """A recurrent cell with a linear answer."""

    def __init__(self, cell: nn.GRUCell | nn.LSTMCell) -> None:
        super().__init__()
        self.cell = cell
        self.answer = nn.Linear(cell.hidden_size, 1)
        self.double()


class RecurrentDriver(NetworkDriver):
    """Drives by a recurrent cell, whose state is the memory: `(P, h)`, of an LSTM `(P, 2 h)`.

    Five seconds of the measured past are shown to it before it drives.
    """

    memory_s = 5.0
    module: _Cell

    def __init__(self, cell: nn.GRUCell | nn.LSTMCell) -> None:
        self.module = _Cell(cell)

    def begin(self, seen: Seen) -> Tensor:
        cell = self.module.cell
        parts = 2 if isinstance(cell, nn.LSTMCell) else 1
        return seen.gap.new_zeros((len(seen.gap), parts * cell.hidden_size))

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        features = features_of(seen)[:, -1]
        cell = self.module.cell
        if isinstance(cell, nn.LSTMCell):
            state = cell(features, tuple(memory.chunk(2, 1)))
            hidden, memory = state[0], torch.cat(state, 1)
        else:
            hidden = memory = cell(features, memory)
        return acceleration_of(self.module.answer(hidden)[:, 0]), memory


class DirectGru(RolloutRival):
    """A GRU that sets the acceleration, trained through its own driving."""

    reference = "Wang et al. (2018), IEEE Trans. Intell. Transp. Syst. 19(3), 910-920"

    def network(self) -> NetworkDriver:
        return RecurrentDriver(nn.GRUCell(FEATURES, self.settings.hidden_size))


class DirectLstm(RolloutRival):
    """An LSTM that sets the acceleration, trained through its own driving."""

    reference = "Huang, Sun and Sun (2018), Transp. Res. C 95, 346-362"

    def network(self) -> NetworkDriver:
        return RecurrentDriver(nn.LSTMCell(FEATURES, self.settings.hidden_size))
