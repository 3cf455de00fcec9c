"""Ensembles: networks that answer together.

Networks that start from different weights and keep different drivers for validation make different
errors, and together they make fewer (L. K. Hansen and P. Salamon, 1990, *Neural network ensembles*,
IEEE PAMI 12).

Shapes: N ensembles of M networks each, B drivers, W windows, f features, n parameters, s width of
the state of one network.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.policies.base import PolicyNetwork

_EDGE = 1e-6


class Ensemble(PolicyNetwork):
    """N ensembles of M networks. All networks of an ensemble read the same tokens.

    An ensemble answers, for each parameter, the median of its networks' answers. Not the mean: one
    answer far out pulls the mean to where no network is, and a model with regimes (Wiedemann 74)
    then drives worse than with each of them. Of an even number the median is the mean of the middle
    two in the squashed space (logits). An ensemble is put together of trained networks, not trained
    itself: the first dimension of its parameters is N M.
    """

    def __init__(self, members: PolicyNetwork, size: int) -> None:
        """Takes N M networks, those of one ensemble behind one another, and M."""
        super().__init__()
        self.members = members  # under this name the weights are saved
        self.size = size

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self._together(self.members.initial_state(networks * self.size, drivers))

    def observe(self, tokens: Tensor, state: Tensor) -> Tensor:
        apart = self._apart(state)
        return self._together(self.members.observe(tokens.repeat_interleave(self.size, 0), apart))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        apart = self._apart(state)
        answers, after = self.members(tokens.repeat_interleave(self.size, 0), apart)
        logits = torch.logit(answers, eps=_EDGE).view(len(state), self.size, *answers.shape[1:])
        return _median(logits).sigmoid(), self._together(after)

    def _apart(self, state: Tensor) -> Tensor:
        """Arranges states `(N, B, M s)` as those of each network, `(N M, B, s)`."""
        networks, drivers, width = state.shape
        apart = state.view(networks, drivers, self.size, width // self.size)
        return apart.transpose(1, 2).flatten(0, 1)

    def _together(self, states: Tensor) -> Tensor:
        """Arranges the networks' states `(N M, B, s)` as `(N, B, M s)`."""
        apart = states.view(len(states) // self.size, self.size, *states.shape[1:])
        return apart.transpose(1, 2).flatten(2)


def _median(values: Tensor) -> Tensor:
    """Returns the medians over the second dimension; NaN where a value is.

    As `quantile(0.5)`, but of operations that exported networks have.
    """
    size = values.shape[1]
    ordered = values.sort(dim=1).values
    median = torch.lerp(ordered[:, (size - 1) // 2], ordered[:, size // 2], 0.5)
    return torch.where(values.isnan().any(dim=1), torch.nan, median)
