"""Tracks of vehicles, and the pairs that they make: one extraction for every such recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.data.files import Floats, Ints
from cfx.data.pairs import Dropped, Pair, PairSet, Remark
from cfx.errors import DataError, listed

__all__ = [
    "NOBODY",
    "SINGLE_FRAME",
    "Marks",
    "accelerations",
    "changes",
    "count_reasons",
    "distance_driven",
    "first_that_holds",
    "frames_apart",
    "next_in_lane",
    "rows_ahead",
    "runs",
    "totals_by_reason",
    "unique_name",
    "vehicles_apart",
]
"""What plugins may use, as `cfx.plugin.tracks`."""


Marks = NDArray[np.bool_]
"""Says of each row whether something holds, `(N,)`."""

NOBODY = 0
"""Stands where no vehicle is ahead."""

SINGLE_FRAME = "a single frame makes no pair"
"""Reason under which readers count rows that are left out because a pair lasts one frame."""

_SAME_LENGTH_M = 0.3
"""m: lengths of one vehicle differ by less."""

_FASTEST_MPS, _PLACE_M = 70.0, 10.0
"""No vehicle goes on faster than this, beside an error of its place; none goes back farther."""

_LEAST_ROWS = 10
"""Rows that tell a vehicle from a few wrong rows of another one."""


_FEW_STEPS = 0.02
"""Share of the steps that are few, where rows are missing."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Rows of vehicles, sorted by recording, vehicle and frame, without duplicates.

    A field is a column that readers give, so that there are as many fields as columns.

    Shapes: every array is `(N,)`, in SI units.

    Attributes:
        source: the file.
        dt: time step, s.
        recordings: names.
        recording: index into `recordings`.
        vehicle: a number from 1 on, unique within a recording.
        frame: number of the frame.
        lane: a number; where it changes, the vehicle has changed lane.
        leader: number of the vehicle ahead; 0 is none.
        position: front bumper along the lane, m. Where gaps are recorded, each vehicle may have an
            origin of its own.
        speed: m/s.
        acceleration: m/s2.
        length: m, as recorded at each row.
        gap: bumper to bumper to the vehicle ahead, m, where the recording gives it; None: it
            follows from positions, and leaders must be in the follower's lane.
        driver_type: index into `driver_types`; None: the recording has no such labels.
        driver_types: labels.
        vehicle_class: what kind of vehicle the source says it is; None: it does not.
        ids_are_unique: no id stands for two vehicles, wherever and whenever it comes again.
        names: what vehicle number i is called, at index i; empty: by its number.
        dropped: what has been left out so far.
        remarks: what was noticed about the source as a whole.
    """

    source: str
    dt: float
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
    gap: Floats | None = None
    driver_type: Ints | None = None
    driver_types: tuple[str, ...] = ()
    vehicle_class: Ints | None = None
    ids_are_unique: bool = False
    names: tuple[str, ...] = ()
    dropped: tuple[Dropped, ...] = ()
    remarks: tuple[Remark, ...] = ()

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def vehicles(self) -> int:
        """How many vehicles there are, over all recordings."""
        return int(np.count_nonzero(changes(self.recording, self.vehicle)))

    def take(self, index: NDArray[Any]) -> Self:
        """Returns the rows at an index or a mask."""
        selected = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                selected[field.name] = value[index]
        return replace(self, **selected)

    def name(self, vehicle: int) -> str:
        """Returns what a vehicle is called."""
        if self.names:
            return self.names[vehicle]
        return str(vehicle)

    def type_at(self, row: int) -> str:
        """Returns what drives the vehicle of a row; "" if that is not known."""
        if self.driver_type is None:
            return ""
        return self.driver_types[int(self.driver_type[row])]


_Tracks = TypeVar("_Tracks", bound=Tracks)


def extract_pairs(tracks: Tracks, *, max_gap: float | None = None) -> PairSet:
    """Cuts tracks into leader-follower pairs.

    A pair is a maximal run of consecutive frames in which one vehicle has the same leader and keeps
    its lane. Only frames count at which the leader's own row exists, in the same lane (unless the
    recording gives gaps), with its rear bumper ahead of the follower's front bumper, and no farther
    than `max_gap`. Any other frame ends the run and is counted in `dropped`: every row is in a pair
    or counted once. `ends` counts why runs end: lane changes of either vehicle, cut-ins, missing
    rows. Runs of a single frame are no pairs.

    An id that stands for two vehicles is taken for two (`vehicles_apart`).

    Args:
        max_gap: m; None: leaders may be anywhere ahead.
    """
    tracks = vehicles_apart(tracks)
    facts = _Facts.of(tracks, max_gap)
    rows = np.flatnonzero(facts.is_following)
    follower = tracks.take(rows)
    leader = tracks.take(facts.ahead[rows])
    starts, sizes = runs(
        follower.recording,
        follower.vehicle,
        follower.leader,
        follower.lane,
        follower.frame - np.arange(len(follower)),
    )
    is_pair = sizes > 1
    reasons = {**facts.left_out(), SINGLE_FRAME: sizes < 2}
    starts, sizes = starts[is_pair], sizes[is_pair]
    return PairSet(
        tuple(_build(follower, leader, facts.gap[rows], starts, sizes)),
        tracks.source,
        (*tracks.dropped, *count_reasons(reasons, "rows")),
        count_reasons(_ends(tracks, facts, rows[starts + sizes - 1]), "pairs"),
        tracks.remarks,
    )


def vehicles_apart(tracks: _Tracks) -> _Tracks:
    """Returns tracks in which an id that stands for two vehicles is two, each of one length.

    Two recordings in one file use the same ids. An id stands for another vehicle from the row on in
    which its length or class changes for good, or in which it is, in the same lane, behind its last
    place or farther ahead than any vehicle drives in that time. A few wrong rows make no vehicle.
    The second vehicle of an id is called `ID-vehicle2`. Lengths become each vehicle's median.
    """
    begins = changes(tracks.recording, tracks.vehicle)
    is_again = np.zeros(len(tracks), dtype=bool)
    if not tracks.ids_are_unique and len(tracks):
        is_again[_changes_of_vehicle(tracks, begins)] = True
    number = np.cumsum(begins | is_again, dtype=np.int64)
    length = pd.Series(tracks.length).groupby(number).transform("median").to_numpy()
    if not is_again.any():
        return replace(tracks, length=length)
    ahead, has_row = rows_ahead(tracks)
    names, twice = _names_apart(tracks, begins, is_again)
    nobody_known = len(names) - 1
    somebody = np.where(tracks.leader == NOBODY, NOBODY, nobody_known)
    remark = Remark(
        f"{len(twice)} ids stand for two vehicles or more ({listed(twice, 5)}): their length, class"
        " or way breaks off; each counts as a vehicle of its own. Are two recordings in one file?"
    )
    return replace(
        tracks,
        vehicle=number,
        leader=np.where(has_row, number[ahead], somebody),
        length=length,
        names=names,
        remarks=(*tracks.remarks, remark),
    )


def _changes_of_vehicle(tracks: Tracks, begins: Marks) -> Ints:
    """Returns the rows at which an id goes over to another vehicle.

    Args:
        begins: whether a row is the first of its id, `(N,)`.
    """
    kind = tracks.vehicle_class
    if kind is None:
        kind = np.zeros(len(tracks), dtype=np.int64)
    breaks = begins | (np.diff(tracks.frame, prepend=tracks.frame[:1]) != 1)
    breaks |= np.abs(np.diff(tracks.length, prepend=tracks.length[:1])) > _SAME_LENGTH_M
    breaks |= changes(kind)
    rows = np.arange(len(tracks))
    breaks |= _cannot_be_driven(tracks, np.maximum(rows - 1, 0), rows, np.ones(len(tracks)))
    starts = np.flatnonzero(breaks)
    last = np.append(starts[1:], len(tracks)) - 1
    is_long = last - starts + 1 >= _LEAST_ROWS
    starts, last = starts[is_long], last[is_long]
    # Each stretch of rows is compared with the one before it, few wrong rows between left out.
    before, start = last[:-1], starts[1:]
    same_id = tracks.recording[before] == tracks.recording[start]
    same_id &= tracks.vehicle[before] == tracks.vehicle[start]
    stretch = np.cumsum(breaks)
    medians = pd.Series(tracks.length).groupby(stretch).transform("median").to_numpy()
    direction = np.sign(tracks.position[before] - tracks.position[starts[:-1]])
    is_other = np.abs(medians[start] - medians[before]) > _SAME_LENGTH_M
    is_other |= kind[start] != kind[before]
    is_other |= _cannot_be_driven(tracks, before, start, np.where(direction < 0, -1.0, 1.0))
    others: Ints = start[same_id & is_other]
    return others


def _cannot_be_driven(tracks: Tracks, before: Ints, after: Ints, direction: Floats) -> Marks:
    """Returns whether no vehicle goes from one row to another in the same lane, `(M,)`.

    Args:
        direction: 1 where positions grow, -1 where they fall.
    """
    moved = (tracks.position[after] - tracks.position[before]) * direction
    seconds = (tracks.frame[after] - tracks.frame[before]) * tracks.dt
    is_impossible = (moved < -_PLACE_M) | (moved > _FASTEST_MPS * seconds + _PLACE_M)
    if tracks.gap is not None:
        # Positions are distances driven, each vehicle's from where its rows begin.
        is_impossible[:] = False
    impossible: Marks = is_impossible & (tracks.lane[after] == tracks.lane[before])
    return impossible


def _names_apart(
    tracks: Tracks, begins: Marks, is_again: Marks
) -> tuple[tuple[str, ...], list[str]]:
    """Returns the vehicles' names by number, and the ids that stand for more than one.

    Number 0 is nobody; the last one stands for whoever has no rows.
    """
    names, twice = [""], []
    order = 1
    for row in np.flatnonzero(begins | is_again).tolist():
        name = tracks.name(int(tracks.vehicle[row]))
        order += 1
        if not is_again[row]:
            order = 1
        if order == 2:
            twice.append(name)
        if order > 1:
            name = f"{name}-vehicle{order}"
        names.append(name)
    return (*names, ""), twice


def count_reasons(reasons: Mapping[str, Marks], unit: str) -> tuple[Dropped, ...]:
    """Returns how often each reason holds; reasons that never hold are left out."""
    counts = []
    for reason, holds in reasons.items():
        count = int(np.count_nonzero(holds))
        if count:
            counts.append(Dropped(reason, count, unit))
    return tuple(counts)


def totals_by_reason(counts: Sequence[Dropped]) -> tuple[Dropped, ...]:
    """Returns one count for each reason, in the order in which they first come."""
    sums: dict[tuple[str, str], int] = {}
    for dropped in counts:
        key = (dropped.reason, dropped.unit)
        sums[key] = sums.get(key, 0) + dropped.count
    totals = []
    for (reason, unit), count in sums.items():
        totals.append(Dropped(reason, count, unit))
    return tuple(totals)


def changes(*keys: NDArray[Any]) -> Marks:
    """Returns `(N,)`, True where a row differs from the one before in any key.

    The first row always does.
    """
    changed = np.zeros(len(keys[0]), dtype=bool)
    changed[:1] = True
    for key in keys:
        changed[1:] |= key[1:] != key[:-1]
    return changed


def runs(*keys: NDArray[Any]) -> tuple[Ints, Ints]:
    """Returns where runs of rows with equal keys start, and how many rows each has."""
    starts = np.flatnonzero(changes(*keys))
    return starts, np.diff(np.append(starts, len(keys[0])))


@dataclass(frozen=True)
class _Facts:
    """Facts of each row and the vehicle ahead; every array is `(N,)`.

    Attributes:
        ahead: index of the leader's row at that frame, 0 where there is none.
        has_row: whether there is one.
        in_lane: whether it is in the same lane.
        gap: m; meaningless where `has_row` is False.
        max_gap: m.
    """

    tracks: Tracks
    ahead: Ints
    has_row: Marks
    in_lane: Marks
    gap: Floats
    max_gap: float

    @classmethod
    def of(cls, tracks: Tracks, max_gap: float | None) -> _Facts:
        ahead, has_row = rows_ahead(tracks)
        if tracks.gap is None:
            in_lane = has_row & (tracks.lane[ahead] == tracks.lane)
            gap = tracks.position[ahead] - tracks.length[ahead] - tracks.position
        else:
            in_lane = has_row
            gap = tracks.gap
        if max_gap is None:
            max_gap = np.inf
        return cls(tracks, ahead, has_row, in_lane, gap, max_gap)

    @property
    def is_behind(self) -> Marks:
        """Whether the leader's rear bumper is not ahead of the follower's front bumper."""
        return self.in_lane & ~(self.gap > 0)

    @property
    def is_far(self) -> Marks:
        """Whether the leader is farther than any that counts."""
        return self.in_lane & (self.gap > self.max_gap)

    @property
    def is_following(self) -> Marks:
        """Whether the row belongs to a pair."""
        return self.in_lane & ~self.is_behind & ~self.is_far

    def left_out(self) -> dict[str, Marks]:
        """Returns the rows that belong to no pair, by reason."""
        has_leader = self.tracks.leader != NOBODY
        return {
            "no vehicle ahead": ~has_leader,
            "the vehicle ahead has no row at that frame": has_leader & ~self.has_row,
            "the vehicle ahead is in another lane": self.has_row & ~self.in_lane,
            "the leader is behind its follower (gap of 0 or less)": self.is_behind,
            f"the leader is farther than {self.max_gap:g} m": self.is_far,
        }


def rows_ahead(tracks: Tracks) -> tuple[Ints, Marks]:
    """Returns the row of each row's leader at that frame, 0 if none, and whether there is one."""
    return _rows_of(tracks, tracks.recording, tracks.leader, tracks.frame)


def next_in_lane(tracks: Tracks) -> tuple[Ints, Marks]:
    """Returns the row of the next vehicle ahead in each row's lane, and whether there is one."""
    ahead = np.zeros(len(tracks), dtype=np.int64)
    has_row = np.zeros(len(tracks), dtype=bool)
    order = np.lexsort((tracks.position, tracks.lane, tracks.frame, tracks.recording))
    behind, front = order[:-1], order[1:]
    is_same_lane = tracks.recording[behind] == tracks.recording[front]
    is_same_lane &= tracks.frame[behind] == tracks.frame[front]
    is_same_lane &= tracks.lane[behind] == tracks.lane[front]
    ahead[behind[is_same_lane]] = front[is_same_lane]
    has_row[behind[is_same_lane]] = True
    return ahead, has_row


def _rows_of(tracks: Tracks, recording: Ints, vehicle: Ints, frame: Ints) -> tuple[Ints, Marks]:
    """Returns the rows of vehicles at frames, `(M,)`: index, 0 if none; whether there is one."""
    if not len(tracks) or not len(vehicle):
        return np.zeros(len(vehicle), dtype=np.int64), np.zeros(len(vehicle), dtype=bool)
    first = int(min(tracks.frame.min(), frame.min()))
    frames = int(max(tracks.frame.max(), frame.max())) - first + 1
    _, ids = np.unique(np.concatenate([tracks.vehicle, vehicle]), return_inverse=True)
    of_rows, sought = ids[: len(tracks)], ids[len(tracks) :]
    vehicles = int(ids.max()) + 1
    # One number for each recording, vehicle and frame; sorted, as the rows are.
    keys = (tracks.recording * vehicles + of_rows) * frames + tracks.frame - first
    sought_keys = (recording * vehicles + sought) * frames + frame - first
    at = np.searchsorted(keys, sought_keys)
    at[at == len(keys)] = 0
    has_row = (keys[at] == sought_keys) & (vehicle != NOBODY)
    return np.where(has_row, at, 0), has_row


def _ends(tracks: Tracks, facts: _Facts, last: Ints) -> dict[str, Marks]:
    """Returns why each pair ends, by reason, `(P,)` each, from the index of its last row."""
    after = np.minimum(last + 1, len(tracks) - 1)
    goes_on = (
        (tracks.vehicle[after] == tracks.vehicle[last])
        & (tracks.recording[after] == tracks.recording[last])
        & (tracks.frame[after] == tracks.frame[last] + 1)
    )
    leader = tracks.leader[last]
    at, leader_goes_on = _rows_of(tracks, tracks.recording[last], leader, tracks.frame[last] + 1)
    next_leader = tracks.leader[after]
    has_next_leader = (next_leader != leader) & (next_leader != NOBODY)
    if tracks.gap is None:
        old_left = tracks.lane[at] != tracks.lane[last]
    else:
        # Lanes of different roads cannot be compared: a vehicle that cuts in comes nearer.
        old_left = has_next_leader & (facts.gap[after] >= facts.gap[last])
    reasons = {
        "the follower's rows end or pause": ~goes_on,
        "the follower changed lane": tracks.lane[after] != tracks.lane[last],
        "the leader's rows end or pause": ~leader_goes_on,
        "the leader changed lane": old_left,
        "another vehicle cut in": has_next_leader,
        "the leader fell behind its follower": facts.is_behind[after],
        f"the leader went farther than {facts.max_gap:g} m": facts.is_far[after],
        "the recording names no leader any more": np.ones(len(last), dtype=bool),
    }
    return first_that_holds(reasons)


def first_that_holds(reasons: Mapping[str, Marks]) -> dict[str, Marks]:
    """Returns the same reasons, where only the first that holds for a row is kept."""
    result = {}
    is_open: Marks | None = None
    for reason, holds in reasons.items():
        if is_open is None:
            is_open = np.ones(len(holds), dtype=bool)
        result[reason] = holds & is_open
        is_open = is_open & ~holds
    return result


def _build(follower: Tracks, leader: Tracks, gap: Floats, starts: Ints, sizes: Ints) -> list[Pair]:
    """Returns a pair for each run of rows."""
    position = follower.position
    if follower.gap is not None:
        position = leader.position - leader.length - gap
    pairs: list[Pair] = []
    runs: dict[str, int] = {}
    for start, size in zip(starts.tolist(), sizes.tolist(), strict=True):
        run = slice(start, start + size)
        recording = follower.recordings[follower.recording[start]]
        leader_id = leader.name(int(leader.vehicle[start]))
        follower_id = follower.name(int(follower.vehicle[start]))
        pair = Pair(
            pair_id=unique_name(f"{recording}-{follower_id}-{leader_id}", runs),
            recording=recording,
            leader_id=leader_id,
            follower_id=follower_id,
            first_frame=int(follower.frame[start]),
            dt=follower.dt,
            leader_length=float(leader.length[start]),
            leader_position=leader.position[run],
            leader_speed=leader.speed[run],
            leader_acceleration=leader.acceleration[run],
            follower_position=position[run],
            follower_speed=follower.speed[run],
            follower_acceleration=follower.acceleration[run],
            lane=int(follower.lane[start]),
            driver_type=follower.type_at(start),
            leader_driver_type=leader.type_at(start),
        )
        pairs.append(pair)
    return pairs


def unique_name(name: str, runs: dict[str, int]) -> str:
    """Returns a pair's id; the second one of a name ends with -run2.

    Args:
        runs: how often each name was given; this call counts too.
    """
    runs[name] = runs.get(name, 0) + 1
    if runs[name] > 1:
        return f"{name}-run{runs[name]}"
    return name


def frames_apart(source: str, recording: Ints, vehicle: Ints, frame: Ints) -> tuple[Ints, int]:
    """Returns frames that follow one another by 1, `(N,)`, and how far apart they were.

    Who thins a recording to every second frame keeps the frames' numbers. Rows are sorted by
    recording, vehicle and frame.

    Raises:
        DataError: the rows of different vehicles are at different frames.
    """
    steps = np.diff(frame)[~changes(recording, vehicle)[1:]]
    if not len(steps):
        return frame, 1
    step = int(np.median(steps))
    if step < 2 or np.count_nonzero(steps % step) > _FEW_STEPS * len(steps):
        return frame, 1
    starts, sizes = runs(recording)
    first = np.repeat(frame[starts], sizes)
    is_between = (frame - first) % step != 0
    if np.count_nonzero(is_between) > _FEW_STEPS * len(frame):
        raise DataError(
            f"{source}: each vehicle has a row at every {step}th frame, but not all at the same"
            " ones, so that nobody is seen together with their leader; keep the same frames of all"
        )
    return frame // step, step


def distance_driven(speed: Floats, dt: float) -> Floats:
    """Returns the distance driven since the first frame, `(T,)`, m.

    As everywhere in cfx, a vehicle moves by its new speed in each step.
    """
    moved = np.zeros_like(speed)
    moved[1:] = np.cumsum(speed[1:]) * dt
    return moved


def follows_from_gaps(pair: Pair) -> bool:
    """Says whether positions follow from gaps and speeds, as where a file has none."""
    difference = (
        pair.leader_position - pair.leader_length - distance_driven(pair.leader_speed, pair.dt)
    )
    return bool(np.abs(difference).max() < 1e-6)


def accelerations(speed: Floats, dt: float) -> Floats:
    """Returns how fast the speed changes, `(T,)`, m/s2: central differences, one-sided at ends."""
    change: NDArray[np.float64] = np.gradient(speed, dt)
    return change


def beyond_rates(values: Floats, rates: Floats, dt: float) -> Floats:
    """Returns how far each step of a signal goes beyond what its rates allow, `(T - 1,)`.

    It is 0 where the signal changes as fast as its rate at either end of the step, or anything
    between: whoever recorded it may have used the old rate, the new one or their mean.

    Args:
        values: the signal, `(T,)`.
        rates: its rate, `(T,)`, per second.
        dt: time step, s.
    """
    moved = np.diff(values)
    least = np.minimum(rates[1:], rates[:-1]) * dt
    most = np.maximum(rates[1:], rates[:-1]) * dt
    beyond: Floats = moved - np.clip(moved, least, most)
    return beyond
