"""NGSIM's rows of vehicles, and the pairs that they make."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.datasets.files import Floats, Ints
from cfx.pairs import Dropped, Pair, PairSet

Marks = NDArray[np.bool_]

FOOT = 0.3048
"""Metres; exact by definition."""

DT = 0.1
"""Seconds between two frames of every NGSIM recording."""

_BOUNDARY_S = 3.0
"""How far from both ends of a vehicle's rows I-80's published speeds have artefacts."""

_ARTEFACT_MPS2 = 0.5
"""From this mean acceleration on, beyond that of the rows between, the ends have artefacts."""


@dataclass(frozen=True)
class Rows:
    """Rows of vehicles, sorted by recording, vehicle and frame, without duplicates.

    Shapes: every array is `(N,)`, in SI units.

    Attributes:
        source: the file.
        recordings: names.
        recording: index into `recordings`.
        vehicle: as recorded.
        frame: as recorded.
        lane: as recorded.
        leader: as recorded; 0 is none.
        position: front bumper, m.
        speed: m/s.
        acceleration: m/s2.
        length: m, one value for each vehicle of a recording.
        rows_read: rows of the file.
        dropped: what has been left out so far.
    """

    source: str
    recordings: tuple[str, ...]
    recording: Ints
    vehicle: Ints
    frame: Ints
    lane: Ints
    leader: Ints
    position: Floats
    speed: Floats
    acceleration: Floats
    length: Floats
    rows_read: int
    dropped: tuple[Dropped, ...]

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def vehicles(self) -> int:
        """How many vehicles there are, over all recordings."""
        return int(np.count_nonzero(changes(self.recording, self.vehicle)))

    def take(self, index: NDArray[Any]) -> Rows:
        """Returns the rows at an index or a mask."""
        taken = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                taken[field.name] = value[index]
        return replace(self, **taken)

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
        ahead, has_row = self._leader_rows()
        in_lane = has_row & (self.lane[ahead] == self.lane)
        gap = self.position[ahead] - self.length[ahead] - self.position
        is_following = in_lane & (gap > 0)
        follower = self.take(is_following)
        leader = self.take(ahead[is_following])
        starts, sizes = _runs(follower)

        counts = {
            "no vehicle ahead": self.leader == 0,
            "the vehicle ahead has no row at that frame": (self.leader != 0) & ~has_row,
            "the vehicle ahead is in another lane": has_row & ~in_lane,
            "the leader is behind its follower (gap of 0 or less)": in_lane & ~(gap > 0),
            "a single frame makes no pair": sizes < 2,
        }
        dropped = list(self.dropped)
        for reason, rows in counts.items():
            count = int(np.count_nonzero(rows))
            if count:
                dropped.append(Dropped(reason, count, "rows"))
        pairs = _build(follower, leader, starts[sizes > 1], sizes[sizes > 1])
        return PairSet(tuple(pairs), self.source, tuple(dropped))

    def _since_and_until(self) -> tuple[Ints, Ints]:
        """Returns frames since the first and until the last row of each row's vehicle, `(N,)`."""
        starts = np.flatnonzero(changes(self.recording, self.vehicle))
        sizes = np.diff(np.append(starts, len(self)))
        first = np.repeat(self.frame[starts], sizes)
        last = np.repeat(self.frame[starts + sizes - 1], sizes)
        return self.frame - first, last - self.frame

    def _leader_rows(self) -> tuple[Ints, Marks]:
        """Returns where each row's leader is at the same frame.

        Returns:
            The index of the leader's row `(N,)`, 0 if there is none; and whether there is one.
        """
        if not len(self):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
        frames = int(self.frame.max()) + 1
        _, ids = np.unique(np.concatenate([self.vehicle, self.leader]), return_inverse=True)
        vehicle, leader = ids[: len(self)], ids[len(self) :]
        vehicles = int(ids.max()) + 1
        # One number for each recording, vehicle and frame; sorted, as the rows are.
        keys = (self.recording * vehicles + vehicle) * frames + self.frame
        wanted = (self.recording * vehicles + leader) * frames + self.frame
        at = np.searchsorted(keys, wanted)
        at[at == len(keys)] = 0
        has_row = (keys[at] == wanted) & (self.leader != 0)
        return np.where(has_row, at, 0), has_row


def changes(*keys: NDArray[Any]) -> Marks:
    """Returns `(N,)`, True where a row differs from the one before in any key.

    The first row always does.
    """
    changed = np.zeros(len(keys[0]), dtype=bool)
    changed[:1] = True
    for key in keys:
        changed[1:] |= key[1:] != key[:-1]
    return changed


def _runs(follower: Rows) -> tuple[Ints, Ints]:
    """Returns where runs of consecutive frames behind the same leader start, and their lengths."""
    changed = changes(
        follower.recording,
        follower.vehicle,
        follower.leader,
        follower.lane,
        follower.frame - np.arange(len(follower)),
    )
    starts = np.flatnonzero(changed)
    return starts, np.diff(np.append(starts, len(follower)))


def _build(follower: Rows, leader: Rows, starts: Ints, sizes: Ints) -> list[Pair]:
    """Returns a pair for each run of rows."""
    pairs: list[Pair] = []
    seen: dict[str, int] = {}
    for start, size in zip(starts.tolist(), sizes.tolist(), strict=True):
        run = slice(start, start + size)
        recording = follower.recordings[follower.recording[start]]
        pair_id = f"{recording}-{follower.vehicle[start]}-{leader.vehicle[start]}"
        seen[pair_id] = seen.get(pair_id, 0) + 1
        if seen[pair_id] > 1:
            pair_id = f"{pair_id}-run{seen[pair_id]}"
        pair = Pair(
            pair_id=pair_id,
            recording=recording,
            leader_id=str(leader.vehicle[start]),
            follower_id=str(follower.vehicle[start]),
            first_frame=int(follower.frame[start]),
            dt=DT,
            leader_length=float(leader.length[start]),
            leader_position=leader.position[run],
            leader_speed=leader.speed[run],
            leader_acceleration=leader.acceleration[run],
            follower_position=follower.position[run],
            follower_speed=follower.speed[run],
            follower_acceleration=follower.acceleration[run],
            lane=int(follower.lane[start]),
        )
        pairs.append(pair)
    return pairs
