"""Drivers on networks: a grid of N networks by B places.

Shapes: D drivers in any order (P pairs, a driver each), N networks, B drivers of the network that
has most, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

ALL = "all"
"""Name of the network that is for any driver."""


def driver_places(network: Tensor) -> Tensor:
    """Numbers the drivers of each network from 0.

    Args:
        network: which network each driver has, `(D,)`.

    Returns:
        `(D,)` int64.
    """
    if len(network) == 0:
        return torch.zeros_like(network)
    order = torch.argsort(network, stable=True)
    counts = torch.bincount(network)
    first = counts.cumsum(0) - counts
    place = torch.empty_like(order)
    place[order] = torch.arange(len(network), device=network.device) - first[network[order]]
    return place


def group_by(names: Sequence[str]) -> tuple[Tensor, tuple[str, ...]]:
    """Groups D drivers by name.

    Returns:
        The number of each driver's group `(D,)`, and the groups' names in order of appearance.
    """
    groups = tuple(dict.fromkeys(names))
    return torch.tensor([groups.index(name) for name in names]), groups


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
