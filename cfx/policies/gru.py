"""The policy `gru`.

K. Cho et al. (2014), *Learning phrase representations using RNN encoder-decoder*, EMNLP.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.recurrent import RecurrentNetwork, RecurrentSettings


class GruNetwork(RecurrentNetwork):
    """N gated recurrent units, in the form of `torch.nn.GRU`."""

    gates = 3
    states = 1

    @staticmethod
    def cell(projected: Tensor, recurrent: Tensor, carried: Tensor) -> Tensor:
        two = 2 * (projected.shape[-1] // 3)
        gates = (projected[..., :two] + recurrent[..., :two]).sigmoid()
        reset, update = gates.chunk(2, dim=-1)
        new = torch.tanh(projected[..., two:] + reset * recurrent[..., two:])
        return torch.lerp(new, carried, update)

    @classmethod
    def cell_in_place(cls, projected: Tensor, recurrent: Tensor, carried: Tensor) -> Tensor:
        two = 2 * (projected.shape[-1] // 3)
        reset, update = projected[..., :two].add_(recurrent[..., :two]).sigmoid_().chunk(2, dim=-1)
        new = projected[..., two:].add_(recurrent[..., two:].mul_(reset)).tanh_()
        return torch.lerp(new, carried, update)


class GruPolicy(Policy):
    """The paper's policy: a recurrent network whose outputs stay in the parameters' bounds.

    Differences from the paper: it does not say whether the network's memory outlives a window; here
    it does, for the whole trajectory. Training starts from calibrated parameters (`start=middle`
    does not): a network that learns little then does little harm.
    """

    schema: ClassVar[type[Settings]] = RecurrentSettings
    settings: RecurrentSettings
    network: ClassVar[type[RecurrentNetwork]] = GruNetwork

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return self.network(features, fixed, self.settings, generator)
