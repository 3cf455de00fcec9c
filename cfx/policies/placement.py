"""Drivers on networks: D drivers in any order are placed on a grid of N networks by B places."""

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
