"""The policy `lstm`.

S. Hochreiter and J. Schmidhuber (1997), *Long short-term memory*, Neural Computation 9(8); F. Gers
et al. (2000).
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.policies.gru import GruPolicy
from cfx.policies.recurrent import RecurrentNetwork


class LstmNetwork(RecurrentNetwork):
    """N long short-term memories as `torch.nn.LSTM`; carries the output and the cell."""

    gates = 4
    states = 2

    @staticmethod
    def cell(projected: Tensor, recurrent: Tensor, carried: Tensor) -> Tensor:
        memory = carried[..., carried.shape[-1] // 2 :]
        h = projected.shape[-1] // 4
        gates = projected + recurrent
        let_in, forget = gates[..., : 2 * h].sigmoid().chunk(2, dim=-1)
        memory = forget * memory + let_in * gates[..., 2 * h : 3 * h].tanh()
        return torch.cat([gates[..., 3 * h :].sigmoid() * memory.tanh(), memory], dim=-1)


class LstmPolicy(GruPolicy):
    """As `gru`, with long short-term memories."""

    network = LstmNetwork
