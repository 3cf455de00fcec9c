"""A policy: a network that chooses parameters from what a driver sees. This one is linear.

A learner calls `build` once; the network's `forward` then sees every window of the training
trajectories, and, when it drives, one window after the other with the `state` it gave before.
"""

from __future__ import annotations

import torch
from cfx.plugin import Policy, PolicyNetwork
from torch import Tensor, nn


class LinearMap(Policy):
    """Answers calibrated parameters until it is trained; has no memory."""

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return LinearNetwork(features, fixed)


class LinearNetwork(PolicyNetwork):
    """N linear maps from f features to n parameters: sigmoid(w x + b).

    At first w is zero and b stands for the calibrated parameters.
    """

    def __init__(self, features: int, fixed: Tensor) -> None:
        """Takes calibrated parameters `(N, n)` in unit space."""
        super().__init__()
        networks, parameters = fixed.shape
        self.weight = nn.Parameter(fixed.new_zeros((networks, features, parameters)))
        self.bias = nn.Parameter(torch.logit(fixed.clamp(0.01, 0.99)))

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self.weight.new_zeros((networks, drivers, 0))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        moved = torch.einsum("nbwf,nfp->nbwp", tokens, self.weight)
        return torch.sigmoid(moved + self.bias[:, None, None]), state
