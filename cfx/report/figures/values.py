"""Numbers of figures: which are finite, which pairs are shown, in which order names stand."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def finite(values: Sequence[float] | Array) -> Array:
    """Returns the finite ones of some values."""
    array: Array = np.asarray(values, dtype=np.float64).ravel()
    return array[np.isfinite(array)]


def natural_order(name: str) -> list[tuple[int, str]]:
    """Returns a sorting key that puts "i80/9" before "i80/11"."""
    key = []
    for part in re.split(r"(\d+)", name):
        if part.isdigit():
            key.append((int(part), ""))
        elif part:
            key.append((-1, part))
    return key


@dataclass(frozen=True)
class RankedPair:
    """A pair worth a look.

    Attributes:
        pair_id: which pair.
        rank: "best", "median", "worst", "3 of 12"; "" where there is nothing to rank.
        improvement: of the RMSE of speed over driver-specific calibration, a fraction; NaN where
            it is not defined.
    """

    pair_id: str
    rank: str
    improvement: float

    @property
    def title(self) -> str:
        """How a figure names it: "best pair, i80-11-1"."""
        return f"{self.rank} pair, {self.pair_id}" if self.rank else f"pair {self.pair_id}"


def rank_pairs(
    pair_ids: Sequence[str], improvements: NDArray[np.floating], count: int = 3
) -> tuple[RankedPair, ...]:
    """Returns `count` pairs from the best to the worst improvement; of one the median.

    Pairs whose improvement is not defined do not take part, unless no pair has a defined one: then
    the first pairs come without a rank.

    Args:
        pair_ids: of P pairs.
        improvements: `(P,)`, fractions.
        count: at most so many.
    """
    values = np.asarray(improvements, dtype=np.float64)
    order = np.argsort(-np.where(np.isfinite(values), values, -np.inf), kind="stable")
    defined = int(np.isfinite(values).sum())
    if not defined:
        return tuple(RankedPair(str(pair), "", float("nan")) for pair in pair_ids[:count])
    chosen = []
    for place in evenly_spread(defined, count):
        index = int(order[place])
        rank = _rank(place, defined, count)
        chosen.append(RankedPair(str(pair_ids[index]), rank, float(values[index])))
    return tuple(chosen)


def evenly_spread(available: int, count: int) -> list[int]:
    """Returns up to `count` places from the first to the last of `available`; of one the middle."""
    if count == 1 or available == 1:
        return [available // 2]
    wanted = min(count, available)
    places = []
    for k in range(wanted):
        # The exact middle of an even number is the later one, as for a single place.
        places.append((2 * k * (available - 1) + wanted - 1) // (2 * (wanted - 1)))
    return places


def _rank(place: int, available: int, count: int) -> str:
    if available == 1:
        return ""
    if count == 1:
        return "median"
    if place == 0:
        return "best"
    if place == available - 1:
        return "worst"
    return "median" if count == 3 else f"{place + 1} of {available}"
