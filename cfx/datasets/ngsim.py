"""NGSIM's own files: vehicle trajectories at 10 Hz, in feet.

U.S. Department of Transportation, Federal Highway Administration: *Next Generation Simulation (NGSIM) Vehicle Trajectories
and Supporting Data*, data.transportation.gov, dataset 8ect-6jqj. In the public domain.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from cfx.component import Settings
from cfx.datasets.base import Dataset, FileDatasetSettings, joined, listed
from cfx.datasets.files import (
    PARQUET,
    Floats,
    Ints,
    Labels,
    TextTable,
    bad_cells,
    magic,
    read_columns,
    sniff,
)
from cfx.errors import DataError, nearest
from cfx.pairs import Dropped, Pair, PairSet

log = logging.getLogger(__name__)

FOOT = 0.3048
"""Metres; exact by definition."""

DT = 0.1
"""Seconds between two frames of every NGSIM recording."""

_HIGHWAY = (
    *(
        "Vehicle_ID",
        "Frame_ID",
        "Total_Frames",
        "Global_Time",
        "Local_X",
        "Local_Y",
        "Global_X",
        "Global_Y",
        "v_Length",
        "v_Width",
    ),
    *(
        "v_Class",
        "v_Vel",
        "v_Acc",
        "Lane_ID",
        "Preceding",
        "Following",
        "Space_Headway",
        "Time_Headway",
    ),
)
_ARTERIAL = (
    *_HIGHWAY[:14],
    "O_Zone",
    "D_Zone",
    "Int_ID",
    "Section_ID",
    "Direction",
    "Movement",
    *_HIGHWAY[14:],
)
"""Arterial recordings (Lankershim, Peachtree) have six columns more, in the middle."""

_NUMBERS = (
    "Vehicle_ID",
    "Frame_ID",
    "Local_Y",
    "v_Length",
    "v_Vel",
    "v_Acc",
    "Lane_ID",
    "Preceding",
)
_CLOCK, _LOCATION = "Global_Time", "Location"
_SPELLINGS = {
    "preceeding": "preceding",
    "precedingvehicle": "preceding",
    "velocity": "vvel",
    "vehiclevelocity": "vvel",
    "acceleration": "vacc",
    "vehicleacceleration": "vacc",
    "length": "vlength",
    "vehiclelength": "vlength",
    "laneidentification": "laneid",
    "lane": "laneid",
}

_NEW_RECORDING_MS = 60_000.0
"""Two recordings of a place start at least this far apart; within one, the clock and the frame count agree far better."""

_FRAME_MS = 1000 * DT

_EDGE_S = 3.0
"""How far from both ends of a vehicle's rows the published speeds of I-80 are bent."""

_BENT_MPS2 = 0.5
"""Mean acceleration over all vehicles, beyond that of their rows between, from which the ends count as bent."""

_DRIVING_MPS = 1.0  # below it, noise of position hides how far a vehicle moves in a frame


class NgsimSettings(FileDatasetSettings):
    """Which part of an NGSIM file to read."""

    location: str | None = Field(
        None,
        description="keep this location of a multi-location export alone (i-80, us-101); null: all",
    )
    trim: float = Field(
        0.0,
        ge=0,
        description="s: leave so much out at both ends of each vehicle's rows, where smoothing has bent its speeds",
    )


class NgsimDataset(Dataset):
    """Pairs from a file as NGSIM publishes it: 18 (arterials: 24) columns without a header, or CSV with one; gzip is fine.

    **A pair** is a maximal run of consecutive frames in which one vehicle has the same leader (`Preceding`) in the same lane.
    Only frames count at which the leader's own row exists, in the same lane, with its rear bumper ahead of the follower's front;
    any other frame ends the run and is counted. Positions are `Local_Y`, speeds and accelerations `v_Vel` and `v_Acc` as
    recorded; 1 ft = 0.3048 m exactly. Runs of a single frame are no pairs.

    **Recordings.** A file may hold several, in which vehicle ids and frames start anew. Each row's `Global_Time - 100 ms *
    Frame_ID` is the instant at which its recording's frame 0 lies, the same for all its rows: rows whose instants differ by more
    than a minute are of different recordings, even if these overlap in time. They are named `LOCATION-1`, `LOCATION-2` in order
    of time (`LOCATION` if there is one alone; the file's name stands in where there is no `Location` column). Without a usable
    clock (no `Global_Time`, or one that a spreadsheet has rounded) each location counts as one recording.

    **Several files** hold several recordings, as NGSIM's own downloads do. Where two of them call theirs alike, as all three
    of I-80 are `i-80`, the file's name is put before the recording's.

    **Bent ends.** In NGSIM's I-80 as published, vehicles seem to speed up by some 1 m/s2 during the first three seconds of their
    rows, and to slow down as much during the last three: all of them, wherever they are, as smoothing over too few rows does. A
    driver who follows such a leader seems to foresee it, and a policy learns that. Where a file is like that, the log says so;
    `trim=3` leaves these rows out, and counts them.

    **Duplicates.** Rows that agree in every column read here are counted and dropped, as real exports hold some; rows that
    contradict each other are an error.

    In the opposite direction of an arterial `Local_Y` decreases; such frames count as "leader behind its follower".
    """

    schema: ClassVar[type[Settings]] = NgsimSettings
    settings: NgsimSettings

    def read(self) -> PairSet:
        parts = _apart([read_ngsim(path, self.settings.location) for path in self.settings.files()])
        if self.settings.trim:
            return joined([rows.trimmed(self.settings.trim).pairs() for rows in parts])
        for rows in parts:
            if bent := rows.bent():
                log.info("%s: %s", rows.source, bent)
        return joined([rows.pairs() for rows in parts])


@dataclass(frozen=True)
class Rows:
    """Rows of vehicles, sorted by recording, vehicle and frame, without duplicates; arrays are `(N,)`, SI units.

    Attributes:
        source: the file.
        recordings: names.
        recording: index into `recordings`.
        vehicle, frame, lane, leader: as recorded; leader 0 is none.
        position: front bumper, m.
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
        return int(np.count_nonzero(_changes(self.recording, self.vehicle)))

    def take(self, index: NDArray[Any]) -> Rows:
        cut = {
            f.name: getattr(self, f.name)[index]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **cut)

    def trimmed(self, seconds: float) -> Rows:
        """Leaves out the rows within so many seconds of their vehicle's first or last one."""
        begun, left = self._since_and_until()
        near = np.minimum(begun, left) < round(seconds / DT)
        if not near.any():
            return self
        lost = Dropped(
            f"within {seconds:g} s of their vehicle's first or last row", int(near.sum()), "rows"
        )
        return replace(self.take(np.flatnonzero(~near)), dropped=(*self.dropped, lost))

    def bent(self) -> str:
        """Says that speeds are bent at the ends of vehicles' rows, "" where they are not: see `NgsimDataset`."""
        begun, left = self._since_and_until()
        edge = round(_EDGE_S / DT)
        ends = (
            begun < edge,
            left < edge,
            (begun >= edge) & (left >= edge),
        )
        if not all(end.any() for end in ends):
            return ""
        first, last, between = (float(self.acceleration[end].mean()) for end in ends)
        if max(abs(first - between), abs(last - between)) < _BENT_MPS2:
            return ""
        return (
            f"in the first and last {_EDGE_S:g} s of their rows vehicles accelerate by {first:+.1f} and {last:+.1f} m/s2 on"
            f" average ({between:+.1f} between): smoothing has bent the ends; leave them out with data.trim={_EDGE_S:g}"
        )

    def _since_and_until(self) -> tuple[Ints, Ints]:
        """Returns frames since the first and until the last row of each row's vehicle, `(N,)`."""
        starts = np.flatnonzero(_changes(self.recording, self.vehicle))
        sizes = np.diff(np.append(starts, len(self)))
        return self.frame - np.repeat(self.frame[starts], sizes), np.repeat(
            self.frame[starts + sizes - 1], sizes
        ) - self.frame

    def pairs(self) -> PairSet:
        """Cuts the rows into pairs: see `NgsimDataset`."""
        ahead, known = self._leader_rows()
        same_lane = known & (self.lane[ahead] == self.lane)
        gap = self.position[ahead] - self.length[ahead] - self.position
        has_constant_baseline = same_lane & (gap > 0)
        follower = self.take(has_constant_baseline)
        leader = self.take(ahead[has_constant_baseline])
        starts = np.flatnonzero(
            _changes(
                follower.recording,
                follower.vehicle,
                follower.leader,
                follower.lane,
                follower.frame - np.arange(len(follower)),
            )
        )
        sizes = np.diff(np.append(starts, len(follower)))
        single = int(np.count_nonzero(sizes < 2))
        dropped = (
            Dropped("no vehicle ahead", int(np.count_nonzero(self.leader == 0)), "rows"),
            Dropped(
                "the vehicle ahead has no row at that frame",
                int(np.count_nonzero((self.leader != 0) & ~known)),
                "rows",
            ),
            Dropped(
                "the vehicle ahead is in another lane",
                int(np.count_nonzero(known & ~same_lane)),
                "rows",
            ),
            Dropped(
                "the leader is behind its follower (gap of 0 or less)",
                int(np.count_nonzero(same_lane & ~(gap > 0))),
                "rows",
            ),
            Dropped("a single frame makes no pair", single, "rows"),
        )
        return PairSet(
            tuple(_build(follower, leader, starts[sizes > 1], sizes[sizes > 1])),
            self.source,
            (*self.dropped, *(d for d in dropped if d.count)),
        )

    def _leader_rows(self) -> tuple[Ints, NDArray[np.bool_]]:
        """Returns for each row the index of its leader's row at the same frame (0 if there is none), and whether there is one."""
        frames = int(self.frame.max(initial=0)) + 1
        _, ids = np.unique(np.concatenate([self.vehicle, self.leader]), return_inverse=True)
        vehicle, leader = ids[: len(self)], ids[len(self) :]
        vehicles = int(ids.max(initial=0)) + 1
        keys = (
            self.recording * vehicles + vehicle
        ) * frames + self.frame  # sorted, as the rows are
        wanted = (self.recording * vehicles + leader) * frames + self.frame
        at = np.searchsorted(keys, wanted)
        at[at == len(keys)] = 0
        known = (keys[at] == wanted) & (self.leader != 0) if len(keys) else np.zeros(0, bool)
        return np.where(known, at, 0), known


def read_ngsim(path: Path, location: str | None = None) -> Rows:
    """Reads an NGSIM file.

    Args:
        location: keep the rows of this location alone.

    Raises:
        DataError: see `NgsimDataset`; the message names file, row and column.
    """
    if magic(path) == PARQUET:
        raise DataError(
            f"{path}: is a parquet file; NGSIM publishes text. Pairs in the tidy layout are read with data=tidy"
        )
    table = sniff(path)
    positions = _columns(table)
    place = {_LOCATION: positions.pop(_LOCATION)} if _LOCATION in positions else {}
    numbers, labels = read_columns(table, positions, place)
    count = len(numbers["Vehicle_ID"])
    if not count:
        raise DataError(f"{path}: has a header but no rows")
    where = labels.get(_LOCATION) or Labels(np.zeros(count, np.int64), [_stem(path)])
    _check(table, numbers, where)
    dropped: list[Dropped] = []
    row = np.arange(count)
    if location is not None:
        row = np.flatnonzero(where.codes == _location_code(table, where, location))
        dropped += (
            [Dropped(f"other locations than '{location}'", count - len(row), "rows")]
            if len(row) < count
            else []
        )
    columns = {name: values[row] for name, values in numbers.items()}
    recording, names = _recordings(columns, where.codes[row], where.names)
    order, again = _sorted(table, columns, recording, row)
    dropped += [Dropped("the same row again", again, "rows")] if again else []
    vehicle = columns["Vehicle_ID"][order].astype(np.int64)
    rows = Rows(
        source=str(path),
        recordings=names,
        recording=recording[order],
        vehicle=vehicle,
        frame=columns["Frame_ID"][order].astype(np.int64),
        lane=columns["Lane_ID"][order].astype(np.int64),
        leader=columns["Preceding"][order].astype(np.int64),
        position=columns["Local_Y"][order] * FOOT,
        speed=columns["v_Vel"][order] * FOOT,
        acceleration=columns["v_Acc"][order] * FOOT,
        length=_lengths(columns["v_Length"][order], recording[order], vehicle) * FOOT,
        rows_read=count,
        dropped=tuple(dropped),
    )
    _check_units(rows)
    return rows


def _apart(parts: Sequence[Rows]) -> list[Rows]:
    """Returns the rows of several files, the recordings of which are named apart, as vehicles' ids start anew in each.

    Raises:
        DataError: two of the files are named alike, too.
    """
    names = Counter(name for rows in parts for name in rows.recordings)
    named: dict[str, str] = {}
    result = []
    for rows in parts:
        stem = _stem(Path(rows.source))
        own = tuple(
            name if names[name] == 1 else stem if name == stem else f"{stem}-{name}"
            for name in rows.recordings
        )
        clash = next((name for name in own if name in named), None)
        if clash is not None:
            raise DataError(
                f"{named[clash]} and {rows.source}: both recordings would be called '{clash}'; rename one of the files"
            )
        named |= dict.fromkeys(own, rows.source)
        result.append(replace(rows, recordings=own))
    return result


def _stem(path: Path) -> str:
    return path.name.split(".")[0] or path.name


def _plain(name: str) -> str:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return _SPELLINGS.get(plain, plain)


def _columns(table: TextTable) -> dict[str, int]:
    """Returns the position of each column wanted, by its published name."""
    if table.header is None:
        layouts = {len(names): names for names in (_HIGHWAY, _ARTERIAL)}
        if table.width not in layouts:
            raise DataError(
                f"{table.path}: its first row has {table.width} columns; NGSIM's files without a header have 18 (arterials: 24)"
            )
        names: Sequence[str] = layouts[table.width]
    else:
        names = table.header
    found: dict[str, int] = {}
    for at, name in enumerate(names):
        found.setdefault(_plain(name), at)
    missing = [name for name in _NUMBERS if _plain(name) not in found]
    if missing:
        hint = nearest(missing[0], names) if len(names) > 1 else ""
        tidy = " This is the tidy pair layout: use data=tidy." if "pairid" in found else ""
        raise DataError(
            f"{table.path}: column {missing[0]} is missing.{hint}{tidy} Columns found: {listed(names, 30)}."
        )
    wanted = (*_NUMBERS, _CLOCK, _LOCATION)
    return {name: found[_plain(name)] for name in wanted if _plain(name) in found}


def _check(table: TextTable, numbers: Mapping[str, Floats], where: Labels) -> None:
    """Raises DataError for the first cell that no recording can hold."""
    for name, values in numbers.items():
        if bad := bad_cells(values):
            index, count, what = bad
            raise DataError(
                f"{table.path}, row {table.row(index)}, column {name}: the cell is {what} ({count} such cells in this column);"
                " correct it or remove the row"
            )
    for name in ("Vehicle_ID", "Frame_ID", "Lane_ID", "Preceding"):
        _reject(
            table,
            numbers,
            name,
            (numbers[name] != np.floor(numbers[name])) | (numbers[name] < 0),
            "is no whole number",
        )
    _reject(table, numbers, "v_Vel", numbers["v_Vel"] < 0, "is negative: a speed cannot be")
    _reject(table, numbers, "v_Length", numbers["v_Length"] <= 0, "is no vehicle length")
    nowhere = np.flatnonzero(where.codes < 0)
    if len(nowhere):
        raise DataError(
            f"{table.path}, row {table.row(nowhere[0])}, column {_LOCATION}: the cell is empty; correct it"
        )


def _reject(
    table: TextTable, numbers: Mapping[str, Floats], name: str, wrong: NDArray[np.bool_], why: str
) -> None:
    at = np.flatnonzero(wrong)
    if len(at):
        raise DataError(
            f"{table.path}, row {table.row(at[0])}, column {name}: {numbers[name][at[0]]:g} {why} ({len(at)} such cells);"
            " correct it"
        )


def _location_code(table: TextTable, where: Labels, location: str) -> int:
    matches = [code for code, name in enumerate(where.names) if name.lower() == location.lower()]
    if not matches:
        raise DataError(
            f"data.location={location}: {table.path} has no such location.{nearest(location, where.names)}"
            f" Known: {listed(where.names)}."
        )
    return matches[0]


def _recordings(
    columns: Mapping[str, Floats], location: Ints, names: Sequence[str]
) -> tuple[Ints, tuple[str, ...]]:
    """Returns the recording `(N,)` of each row as an index, and the recordings' names: see `NgsimDataset`."""
    start = np.zeros(len(location))
    if _CLOCK in columns and _clock_ticks(columns, location):
        start = columns[_CLOCK] - _FRAME_MS * columns["Frame_ID"]
    order = np.lexsort((start, location))
    begins = np.zeros(len(order), dtype=bool)
    begins[1:] = np.diff(location[order]) != 0
    begins[1:] |= np.diff(start[order]) > _NEW_RECORDING_MS
    recording = np.empty(len(order), dtype=np.int64)
    recording[order] = np.cumsum(begins)
    place = location[order][np.append(True, begins[1:])] if len(order) else location
    number = np.arange(len(place)) - np.searchsorted(place, place) + 1
    several = np.bincount(place)[place] > 1 if len(place) else place
    return recording, tuple(
        f"{names[p]}-{k}" if many else names[p]
        for p, k, many in zip(place, number, several, strict=True)
    )


def _clock_ticks(columns: Mapping[str, Floats], location: Ints) -> bool:
    """Says whether `Global_Time` advances by 100 ms from one frame of a vehicle to its next."""
    clock, frame, vehicle = columns[_CLOCK], columns["Frame_ID"], columns["Vehicle_ID"]
    order = np.lexsort((frame, clock, vehicle, location))
    successive = (
        (np.diff(vehicle[order]) == 0)
        & (np.diff(location[order]) == 0)
        & (np.diff(frame[order]) == 1)
    )
    ticks = np.diff(clock[order])[successive]
    return bool(len(ticks)) and abs(float(np.median(ticks)) - _FRAME_MS) < 0.1 * _FRAME_MS


def _sorted(
    table: TextTable, columns: Mapping[str, Floats], recording: Ints, row: Ints
) -> tuple[Ints, int]:
    """Returns the order by recording, vehicle and frame without duplicates, and how many duplicates there were."""
    order = np.lexsort((columns["Frame_ID"], columns["Vehicle_ID"], recording))
    same = ~_changes(recording[order], columns["Vehicle_ID"][order], columns["Frame_ID"][order])
    again = np.flatnonzero(same)
    before, after = order[again - 1], order[again]
    differs = np.zeros(len(again), dtype=bool)
    for values in columns.values():
        differs |= values[before] != values[after]
    if differs.any():
        a, b = sorted((row[before[differs][0]], row[after[differs][0]]))
        vehicle, frame = (columns[name][after[differs][0]] for name in ("Vehicle_ID", "Frame_ID"))
        raise DataError(
            f"{table.path}, rows {table.row(a)} and {table.row(b)}: vehicle {vehicle:.0f} has two different rows at frame"
            f" {frame:.0f} ({int(differs.sum())} such pairs of rows); keep one of them, or, if the file holds several"
            " recordings, give it Global_Time in milliseconds so that they can be told apart"
        )
    return order[~same], len(again)


def _lengths(length: Floats, recording: Ints, vehicle: Ints) -> Floats:
    """Returns each vehicle's median length at each of its rows."""
    group = np.cumsum(_changes(recording, vehicle))
    medians: Floats = pd.Series(length).groupby(group).transform("median").to_numpy()
    return medians


def _check_units(rows: Rows) -> None:
    typical = float(np.median(rows.length)) / FOOT
    if typical < 8:
        raise DataError(
            f"{rows.source}, column v_Length: vehicles are typically {typical:.1f} long, which looks like metres; NGSIM's files"
            " are in feet. Convert the file back, or write its pairs in the tidy layout (SI units) and use data=tidy"
        )
    step = (
        ~_changes(rows.recording, rows.vehicle)[1:]
        & (np.diff(rows.frame) == 1)
        & (rows.speed[1:] > _DRIVING_MPS)
    )
    ratios = np.abs(np.diff(rows.position)[step]) / (rows.speed[1:][step] * DT)
    ratio = float(np.median(ratios)) if len(ratios) else 1.0
    if not 0.8 < ratio < 1.25:
        raise DataError(
            f"{rows.source}, columns Local_Y and v_Vel: from frame to frame vehicles typically advance by {ratio:.3g} times their"
            " speed times 0.1 s; both columns must be in feet (ft and ft/s)"
        )


def _changes(*keys: NDArray[Any]) -> NDArray[np.bool_]:
    """Returns `(N,)`, True where a row differs from the one before in any key; the first row always does."""
    changed = np.zeros(len(keys[0]), dtype=bool)
    changed[:1] = True
    for key in keys:
        changed[1:] |= key[1:] != key[:-1]
    return changed


def _build(follower: Rows, leader: Rows, starts: Ints, sizes: Ints) -> Sequence[Pair]:
    pairs, seen = [], dict[str, int]()
    for start, size in zip(starts.tolist(), sizes.tolist(), strict=True):
        run = slice(start, start + size)
        recording = follower.recordings[follower.recording[start]]
        name = f"{recording}-{follower.vehicle[start]}-{leader.vehicle[start]}"
        seen[name] = seen.get(name, 0) + 1
        pairs.append(
            Pair(
                pair_id=name if seen[name] == 1 else f"{name}-run{seen[name]}",
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
        )
    return pairs
