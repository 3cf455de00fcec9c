"""What several choices share."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def finite(values: Sequence[float] | Array) -> Array:
    """Returns the finite ones of some values."""
    array: Array = np.asarray(values, dtype=np.float64).ravel()
    return array[np.isfinite(array)]


def without_infinity(signal: Array) -> Array:
    """Returns the signal with NaN for infinity, which no axis can show."""
    return np.where(np.isfinite(signal), signal, np.nan)


def natural_order(name: str) -> list[tuple[int, str]]:
    """Returns a sorting key that puts "i80/9" before "i80/11"."""
    key = []
    for part in re.split(r"(\d+)", name):
        if part.isdigit():
            key.append((int(part), ""))
        elif part:
            key.append((-1, part))
    return key
