"""NGSIM's rows of vehicles, and the pairs that they make."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cfx.data.files import Ints
from cfx.data.pairs import Dropped, PairSet
from cfx.data.tracks import Tracks, changes, extract_pairs

FOOT = 0.3048
"""Metres; exact by definition."""

DT = 0.1
"""Seconds between two frames of every NGSIM recording."""

_BOUNDARY_S = 3.0
"""How far from both ends of a vehicle's rows I-80's published speeds have artefacts."""

_ARTEFACT_MPS2 = 0.5
"""From this mean acceleration on, beyond that of the rows between, the ends have artefacts."""


@dataclass(frozen=True, kw_only=True)
class Rows(Tracks):
    """Rows of an NGSIM file.

    Attributes:
        rows_read: rows of the file.
    """

    rows_read: int

    def trimmed(self, seconds: float) -> Rows:
        """Leaves out the rows within so many seconds of their vehicle's first or last one."""
        since, until = self._since_and_until()
        near = np.minimum(since, until) < round(seconds / DT)
        if not near.any():
            return self
        reason = f"within {seconds:g} s of their vehicle's first or last row"
        lost = Dropped(reason, int(near.sum()), "rows")
        return replace(self.take(np.flatnonzero(~near)), dropped=(*self.dropped, lost))

    def boundary_artefacts(self) -> str:
        """Says that smoothing left artefacts at the ends of vehicles' rows; "" if it did not.

        See `NgsimDataset`.
        """
        since, until = self._since_and_until()
        edge = round(_BOUNDARY_S / DT)
        is_first = since < edge
        is_last = until < edge
        is_between = ~is_first & ~is_last
        if not (is_first.any() and is_last.any() and is_between.any()):
            return ""
        first = float(self.acceleration[is_first].mean())
        last = float(self.acceleration[is_last].mean())
        between = float(self.acceleration[is_between].mean())
        if max(abs(first - between), abs(last - between)) < _ARTEFACT_MPS2:
            return ""
        return (
            f"in the first and last {_BOUNDARY_S:g} s of their rows vehicles accelerate by"
            f" {first:+.1f} and {last:+.1f} m/s2 on average ({between:+.1f} between): these are"
            " boundary artefacts of smoothing;"
            f" leave them out with data.trim={_BOUNDARY_S:g}"
        )

    def pairs(self) -> PairSet:
        """Cuts the rows into pairs: see `NgsimDataset`."""
        return extract_pairs(self)

    def _since_and_until(self) -> tuple[Ints, Ints]:
        """Returns frames since the first and until the last row of each row's vehicle, `(N,)`."""
        starts = np.flatnonzero(changes(self.recording, self.vehicle))
        sizes = np.diff(np.append(starts, len(self)))
        first = np.repeat(self.frame[starts], sizes)
        last = np.repeat(self.frame[starts + sizes - 1], sizes)
        return self.frame - first, last - self.frame
