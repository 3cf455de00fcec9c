"""What stochastic drivers draw: random numbers that belong to a vehicle and an instant.

A number depends on the seed, the vehicle's id and the simulated time alone. So another order of the
vehicles, more of them, or a simulation that goes on from a saved state changes nobody's driver.

Shapes: D vehicles, k numbers of a window.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

_BYTES = 8
"""Of one number."""

_BITS = 53
"""Of a double's fraction."""


def standard_normal(seed: int, vehicles: Sequence[str], now: float, count: int) -> Tensor:
    """Draws the numbers of one window of each vehicle.

    Args:
        seed: any integer.
        vehicles: their ids, D of them.
        now: simulated time at which the window begins, s; known to 1 ms, as SUMO's.
        count: k.

    Returns:
        `(D, k)`, each standard normal and independent of the others.
    """
    uniform = _uniform(f"{seed}/{round(1000 * now)}", vehicles, count)
    normal: Tensor = torch.special.ndtri(uniform)
    return normal


def uniform_of_vehicles(seed: int, vehicles: Sequence[str]) -> Tensor:
    """Draws a number from 0 to 1 for each vehicle, `(D,)`: who drives it, at any time.

    Args:
        seed: any integer.
        vehicles: their ids, D of them.
    """
    return _uniform(f"{seed}/driver", vehicles, 1)[:, 0]


def _uniform(about: str, vehicles: Sequence[str], count: int) -> Tensor:
    """Returns numbers between 0 and 1 that depend on these words and each vehicle's id."""
    drawn = bytearray()
    for vehicle in vehicles:
        words = f"{about}/{vehicle}".encode()
        drawn += hashlib.shake_128(words).digest(_BYTES * count)
    whole = np.frombuffer(bytes(drawn), dtype="<u8") >> (64 - _BITS)
    uniform = (whole.astype(np.float64) + 0.5) * 2.0**-_BITS
    return torch.from_numpy(uniform).reshape(len(vehicles), count)
