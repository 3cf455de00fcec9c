"""How often values occur, in memory that does not grow with their number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Histogram:
    """Counts values in bins of equal width; those beyond the ends count in the last bins.

    Args:
        low, high: ends.
        width: of a bin, which is also how exactly quantiles are known.
    """

    def __init__(self, low: float, high: float, width: float) -> None:
        self.low, self.width = low, width
        self.counts = np.zeros(round((high - low) / width), dtype=np.int64)

    def add(self, values: Sequence[float] | np.ndarray) -> None:
        """Counts values; those that are not finite are left out."""
        array = np.asarray(values, dtype=np.float64)
        array = array[np.isfinite(array)]
        places = ((array - self.low) / self.width).astype(np.int64)
        np.add.at(self.counts, places.clip(0, len(self.counts) - 1), 1)

    def quantile(self, share: float) -> float:
        """Returns the value below which this share lies, to half a bin; NaN if there is none."""
        total = int(self.counts.sum())
        if total == 0:
            return float("nan")
        place = int(np.searchsorted(self.counts.cumsum(), share * total))
        return self.low + (place + 0.5) * self.width
