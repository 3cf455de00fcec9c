"""Gated recurrent units.

K. Cho et al. (2014), *Learning phrase representations using RNN encoder-decoder*, EMNLP.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.recurrent import RecurrentLayer, RecurrentNetwork, RecurrentSettings


class GruNetwork(RecurrentNetwork):
    """N gated recurrent units, in the form of `torch.nn.GRU`."""

    gates = 3
    states = 1

    def cell(self, projected: Tensor, layer: RecurrentLayer, carried: Tensor) -> Tensor:
        recurrent = layer.recur(carried)
        h = self.hidden
        gates = (projected[..., : 2 * h] + recurrent[..., : 2 * h]).sigmoid()
        reset, update = gates.chunk(2, dim=-1)
        new = torch.tanh(projected[..., 2 * h :] + reset * recurrent[..., 2 * h :])
        return torch.lerp(new, carried, update)


class GruPolicy(Policy):
    """The paper's policy: a recurrent network whose outputs stay in the parameters' bounds.

    Differences from the paper: it does not say whether the network's memory outlives a window; here
    it does, for the whole trajectory. Training starts from the fixed parameters (`start=middle`
    does not): a network that learns little then does little harm.
    """

    schema: ClassVar[type[Settings]] = RecurrentSettings
    settings: RecurrentSettings

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return GruNetwork(features, fixed, self.settings, generator)
