"""Pairs placed as networks by drivers.

Shapes: P pairs, N networks, B drivers of the network that has most, n tuned parameters.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.policies.placement import driver_places


class Grid:
    """Places P pairs as N networks by B drivers."""

    def __init__(self, network: Tensor, networks: int) -> None:
        """Takes which network learns from each pair, `(P,)`."""
        self.network = network
        self.place = driver_places(network)
        self.shape = (networks, int(self.place.max()) + 1)

    def scatter(self, values: Tensor) -> Tensor:
        """Arranges `(P, ...)` as `(N, B, ...)`, zero where a network has fewer drivers."""
        grid = values.new_zeros((*self.shape, *values.shape[1:]))
        grid[self.network, self.place] = values
        return grid

    def mean(self, values: Tensor) -> Tensor:
        """Returns the mean of `(P, n)` over each network's pairs, `(N, n)`."""
        networks = self.shape[0]
        total = values.new_zeros((networks, values.shape[1]))
        total = total.index_add_(0, self.network, values)
        return total / torch.bincount(self.network, minlength=networks)[:, None]
