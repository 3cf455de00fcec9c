"""NGSIM's own files: vehicle trajectories at 10 Hz, in feet.

U.S. Department of Transportation, Federal Highway Administration: *Next Generation Simulation
(NGSIM) Vehicle Trajectories and Supporting Data*, data.transportation.gov, dataset 8ect-6jqj. In
the public domain.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
from pydantic import Field

from cfx.errors import DataError, listed, nearest
from cfx.plugin import (
    Contents,
    Dataset,
    Dropped,
    FileColumn,
    FileDatasetSettings,
    FileStart,
    Floats,
    Ints,
    Layout,
    NameColumn,
    PairSet,
    Settings,
    Table,
    Tracks,
    extract_pairs,
    joined,
    read_table,
    statements,
    stem,
    tracks,
)

FOOT = 0.3048
"""Metres; exact by definition."""

DT = 0.1
"""Seconds between two frames of every NGSIM recording."""

_BOUNDARY_S = 3.0
"""How far from both ends of a vehicle's rows I-80's published speeds have artefacts."""

_ARTEFACT_MPS2 = 0.5
"""From this mean acceleration on, beyond that of the rows between, the ends have artefacts."""


_BEFORE_ZONES = (
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
    "v_Class",
    "v_Vel",
    "v_Acc",
    "Lane_ID",
)
_ZONES = ("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement")
_AFTER_ZONES = ("Preceding", "Following", "Space_Headway", "Time_Headway")

MOTORWAY = (*_BEFORE_ZONES, *_AFTER_ZONES)
"""Columns of a file of a motorway, in the order in which they are published."""

_CLOCK, _LOCATION = "Global_Time", "Location"
"""Columns that are used where they are there."""

_HEADWAYS = ("Space_Headway", "Time_Headway")
"""Columns that follow from others: they are compared with these where they are there."""

_BESIDES = (*_HEADWAYS, "v_Class")
"""Columns that may be empty: by them no two rows of a vehicle at a frame are told apart."""

_NO_TIME_HEADWAY = 9999.0
"""s; from here on `Time_Headway` says that the vehicle stands."""

_SPELLINGS = {
    "preceeding": "preceding",
    "precedingvehicle": "preceding",
    "velocity": "vvel",
    "vehiclevelocity": "vvel",
    "acceleration": "vacc",
    "vehicleacceleration": "vacc",
    "spacehdwy": "spaceheadway",
    "timehdwy": "timeheadway",
    "length": "vlength",
    "vehiclelength": "vlength",
    "laneidentification": "laneid",
    "lane": "laneid",
}
"""Other names of columns that exports have, as `_plain` writes them."""

_NEW_RECORDING_MS = 60_000.0
"""Two recordings of a place start at least this far apart.

Within one recording the clock and the frame count agree far better.
"""

_FRAME_MS = 1000 * DT

_MOST_FRAMES = 20
"""Frames of NGSIM that a thinned file leaves out from one row of a vehicle to its next, at most."""

_RECORDED_ON = {
    "2005-04-13": "i-80",
    "2005-06-15": "us-101",
    "2005-06-16": "lankershim",
    "2006-11-08": "peachtree",
}
"""The day of each location's recordings, local time, and what its `Location` is called."""

_BEHIND_UTC_MS = 7 * 3_600_000.0
"""From UTC to the local time of California in summer; Atlanta's recordings keep their day."""

_UNITS = {"position": "ft", "speed": "ft/s", "acceleration": "ft/s2", "gap": "ft"}
_UNITS |= {f"leader_{name}": unit for name, unit in _UNITS.items()}
"""Units of the layout, by `Dataset.units`'s names."""


def _plain(name: str) -> str:
    """Returns a column's name in lower case without separators, in one of its spellings."""
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return _SPELLINGS.get(plain, plain)


def _count(name: str) -> FileColumn:
    return FileColumn(name, whole=True, least=0, wrong="is no whole number; correct it")


_LAYOUT = Layout(
    name="NGSIM",
    columns=(
        _count("Vehicle_ID"),
        _count("Frame_ID"),
        FileColumn("Local_Y", "ft"),
        FileColumn("v_Length", "ft", above=0, wrong="is no vehicle length; correct it"),
        FileColumn("v_Vel", "ft/s", least=0, wrong="is negative: a speed cannot be; correct it"),
        FileColumn("v_Acc", "ft/s2"),
        _count("Lane_ID"),
        _count("Preceding"),
        FileColumn(_CLOCK, "ms", needed=False),
        FileColumn(_LOCATION, is_name=True, needed=False),
        FileColumn("v_Class", needed=False, may_be_empty=True),
        FileColumn("Space_Headway", "ft", needed=False, may_be_empty=True),
        FileColumn("Time_Headway", "s", needed=False, may_be_empty=True),
    ),
    elsewhere={"pairid": "This is the tidy pair layout: use data=tidy."},
    headerless={18: MOTORWAY, 24: (*_BEFORE_ZONES, *_ZONES, *_AFTER_ZONES)},
    spaces=True,
    plain=_plain,
)


@dataclass(frozen=True, kw_only=True)
class Rows(Tracks):
    """Rows of an NGSIM file.

    Attributes:
        rows_read: rows of the file.
        sites: of each of `recordings`; "" where it is not known.
    """

    rows_read: int
    sites: tuple[str, ...]

    def trimmed(self, seconds: float) -> Rows:
        """Leaves out the rows within so many seconds of their vehicle's first or last one."""
        since, until = self._since_and_until()
        near = np.minimum(since, until) < round(seconds / self.dt)
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
        edge = round(_BOUNDARY_S / self.dt)
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
        site = dict(zip(self.recordings, self.sites, strict=True))
        return extract_pairs(self).changed(lambda pair: replace(pair, site=site[pair.recording]))

    def _since_and_until(self) -> tuple[Ints, Ints]:
        """Returns frames since the first and until the last row of each row's vehicle, `(N,)`."""
        starts = np.flatnonzero(tracks.changes(self.recording, self.vehicle))
        sizes = np.diff(np.append(starts, len(self)))
        first = np.repeat(self.frame[starts], sizes)
        last = np.repeat(self.frame[starts + sizes - 1], sizes)
        return self.frame - first, last - self.frame


def read_ngsim(path: Path, location: str | None = None) -> Rows:
    """Reads an NGSIM file.

    Args:
        location: keep the rows of this location alone.

    Raises:
        DataError: see `NgsimDataset`; the message names file, row and column.
    """
    table = read_table(path, _LAYOUT)
    numbers, count = table.numbers, len(table)
    where = table.labels.get(_LOCATION) or NameColumn(np.zeros(count, np.int64), [stem(path)])
    dropped = []
    row = np.arange(count)
    if location is not None:
        row = np.flatnonzero(where.codes == _location_code(table, where, location))
        if len(row) < count:
            reason = f"other locations than '{location}'"
            dropped.append(Dropped(reason, count - len(row), "rows"))
    columns = {name: values[row] for name, values in numbers.items()}
    recording, names, places = _recordings(columns, where.codes[row], where.names)
    if _LOCATION not in table.labels:
        places = _by_day(columns, recording, len(names))
    order, again = _sorted(table, columns, recording, row)
    if again:
        dropped.append(Dropped("the same row again", again, "rows"))
    ordered = {name: values[order] for name, values in columns.items()}
    frame, step = _frames(str(path), ordered, recording[order], where.codes[row][order])
    rows = _rows(str(path), names, places, recording[order], ordered, count, dropped)
    rows = replace(rows, frame=frame, dt=step)
    _check_units(rows)
    rows = tracks.vehicles_apart(rows)
    return replace(
        rows, remarks=(*rows.remarks, *statements.remarks_of(_said_twice(rows, ordered)))
    )


def _frames(
    source: str, columns: Mapping[str, Floats], recording: Ints, location: Ints
) -> tuple[Ints, float]:
    """Returns the frame of each row `(N,)`, and the time step, s.

    Thinned files keep NGSIM's frames, two or more apart, or number theirs anew; then the clock says
    how long a frame is.
    """
    frame = columns["Frame_ID"].astype(np.int64)
    vehicle = columns["Vehicle_ID"].astype(np.int64)
    frame, apart = tracks.frames_apart(source, recording, vehicle, frame)
    step = DT * apart
    if apart == 1 and _CLOCK in columns:
        tick = _tick(columns, location)
        frames = tick / _FRAME_MS
        if 1.5 < frames <= _MOST_FRAMES and abs(frames - round(frames)) < 0.1:
            step = DT * round(frames)
    return frame, round(step, 9)


def _said_twice(rows: Rows, columns: Mapping[str, Floats]) -> Iterator[statements.Statement]:
    """Yields what columns of a file say that follows from others too, in the file's units."""
    ahead, has_row = tracks.rows_ahead(rows)
    headway = np.where(has_row, rows.position[ahead] - rows.position, np.nan) / FOOT
    # In the opposite direction of an arterial Local_Y decreases, and who is next is behind.
    headway[headway < 0] = np.nan
    following, is_there = tracks.next_in_lane(rows)
    to_next = np.where(is_there, rows.position[following] - rows.position, np.nan) / FOOT
    basis = "Local_Y and Lane_ID, by which another vehicle is the next ahead"
    yield statements.Statement("the distance to the Preceding", headway, [to_next], basis)
    said = columns.get("Space_Headway")
    if said is None:
        return
    yield statements.Statement(
        "Space_Headway", said, [headway], "Local_Y of a vehicle and its Preceding"
    )
    time_headway = columns.get("Time_Headway")
    if time_headway is not None:
        moves = (columns["v_Vel"] > 0) & (time_headway < _NO_TIME_HEADWAY)
        speed = np.where(moves, columns["v_Vel"], np.nan)
        yield statements.Statement(
            "Time_Headway", time_headway, [said / speed], "Space_Headway and v_Vel"
        )


def _rows(
    source: str,
    names: tuple[str, ...],
    sites: tuple[str, ...],
    recording: Ints,
    columns: Mapping[str, Floats],
    count: int,
    dropped: Sequence[Dropped],
) -> Rows:
    """Returns columns in feet, which are in order already, as rows in SI units."""
    vehicle = columns["Vehicle_ID"].astype(np.int64)
    return Rows(
        source=source,
        dt=DT,
        recordings=names,
        recording=recording,
        vehicle=vehicle,
        frame=columns["Frame_ID"].astype(np.int64),
        lane=columns["Lane_ID"].astype(np.int64),
        leader=columns["Preceding"].astype(np.int64),
        position=columns["Local_Y"] * FOOT,
        speed=columns["v_Vel"] * FOOT,
        acceleration=columns["v_Acc"] * FOOT,
        length=columns["v_Length"] * FOOT,
        vehicle_class=_classes(columns),
        rows_read=count,
        sites=sites,
        dropped=tuple(dropped),
    )


def _location_code(table: Table, where: NameColumn, location: str) -> int:
    """Returns the index of a location in `where.names`."""
    for code, name in enumerate(where.names):
        if name.lower() == location.lower():
            return code
    raise DataError(
        f"data.location={location}: {table.source} has no such location."
        f"{nearest(location, where.names)} Known: {listed(where.names)}."
    )


def _recordings(
    columns: Mapping[str, Floats], location: Ints, names: Sequence[str]
) -> tuple[Ints, tuple[str, ...], tuple[str, ...]]:
    """Returns the recording of each row and the recordings' names: see `NgsimDataset`.

    Args:
        columns: of the file.
        location: of each row `(N,)`, an index into `names`.
        names: of the locations.

    Returns:
        An index `(N,)` into the names of recordings, these names, and the location of each.
    """
    start = np.zeros(len(location))
    if _CLOCK in columns and _clock_ticks(columns, location):
        start = columns[_CLOCK] - _FRAME_MS * columns["Frame_ID"]
    order = np.lexsort((start, location))
    begins = np.zeros(len(order), dtype=bool)
    begins[1:] = np.diff(location[order]) != 0
    begins[1:] |= np.diff(start[order]) > _NEW_RECORDING_MS
    recording = np.empty(len(order), dtype=np.int64)
    recording[order] = np.cumsum(begins)

    begins[:1] = True
    locations = location[order][begins]  # of each recording
    counts = np.bincount(locations, minlength=len(names))
    numbers = np.zeros(len(names), dtype=np.int64)
    recordings = []
    for code in locations.tolist():
        numbers[code] += 1
        name = names[code]
        if counts[code] > 1:
            name = f"{name}-{numbers[code]}"
        recordings.append(name)
    return recording, tuple(recordings), tuple(names[code] for code in locations.tolist())


def _by_day(columns: Mapping[str, Floats], recording: Ints, count: int) -> tuple[str, ...]:
    """Returns the location of each recording by the day of its clock; "" where no day fits."""
    if _CLOCK not in columns:
        return ("",) * count
    clock = pd.Series(columns[_CLOCK] - _BEHIND_UTC_MS).groupby(recording).median()
    days = pd.to_datetime(clock, unit="ms", errors="coerce").dt.strftime("%Y-%m-%d")
    return tuple(days.map(_RECORDED_ON).fillna(""))


def _clock_ticks(columns: Mapping[str, Floats], location: Ints) -> bool:
    """Says whether `Global_Time` advances by 100 ms for each frame of a vehicle."""
    return abs(_tick(columns, location) - _FRAME_MS) < 0.1 * _FRAME_MS


def _tick(columns: Mapping[str, Floats], location: Ints) -> float:
    """Returns by how much `Global_Time` typically advances in a frame, ms; 0 if nothing says it."""
    clock, frame, vehicle = columns[_CLOCK], columns["Frame_ID"], columns["Vehicle_ID"]
    order = np.lexsort((frame, clock, vehicle, location))
    steps = np.diff(frame[order])
    successive = (
        (np.diff(vehicle[order]) == 0)
        & (np.diff(location[order]) == 0)
        & (steps >= 1)
        & (steps <= _MOST_FRAMES)
    )
    ticks = np.diff(clock[order])[successive] / steps[successive]
    return float(np.median(ticks)) if len(ticks) else 0.0


def _sorted(
    table: Table, columns: Mapping[str, Floats], recording: Ints, row: Ints
) -> tuple[Ints, int]:
    """Returns the order by recording, vehicle and frame, and how many duplicates it leaves out.

    Raises:
        DataError: a vehicle has two different rows at a frame.
    """
    order = np.lexsort((columns["Frame_ID"], columns["Vehicle_ID"], recording))
    is_same = ~tracks.changes(
        recording[order], columns["Vehicle_ID"][order], columns["Frame_ID"][order]
    )
    again = np.flatnonzero(is_same)
    before, after = order[again - 1], order[again]
    differs = np.zeros(len(again), dtype=bool)
    for name, values in columns.items():
        if name not in _BESIDES:
            differs |= values[before] != values[after]
    if differs.any():
        first, second = before[differs][0], after[differs][0]
        a, b = sorted((row[first], row[second]))
        vehicle, frame = columns["Vehicle_ID"][second], columns["Frame_ID"][second]
        raise DataError(
            f"{table.source}, rows {table.row(a)} and {table.row(b)}: vehicle {vehicle:.0f} has two"
            f" different rows at frame {frame:.0f} ({int(differs.sum())} such pairs of rows); keep"
            " one of them, or, if the file holds several recordings, give it Global_Time in"
            " milliseconds so that they can be told apart"
        )
    return order[~is_same], len(again)


def _classes(columns: Mapping[str, Floats]) -> Ints | None:
    """Returns the number of each row's vehicle class, 0 where the cell is empty; None if none."""
    if "v_Class" not in columns:
        return None
    return np.nan_to_num(columns["v_Class"]).astype(np.int64)


def _check_units(rows: Rows) -> None:
    """Raises DataError if lengths seem not to be in feet."""
    typical = float(np.median(rows.length)) / FOOT
    if typical < 8:
        raise DataError(
            f"{rows.source}, column v_Length: vehicles are typically {typical:.1f} long, which"
            " looks like metres; NGSIM's files are in feet. Convert the file back, or write its"
            " pairs in the tidy layout (SI units) and use data=tidy"
        )


log = logging.getLogger(__name__)


class NgsimSettings(FileDatasetSettings):
    """Settings of the NGSIM reader."""

    location: str | None = Field(
        None,
        description="keep this location of a multi-location export alone (i-80, us-101); null: all",
    )
    trim: float = Field(
        0.0,
        ge=0,
        description="s: leave so much out at both ends of each vehicle's rows, where smoothing has"
        " left artefacts in its speeds",
    )


class NgsimDataset(Dataset):
    """Pairs from a file as NGSIM publishes it.

    The file has 18 columns (arterials: 24) without a header, or is CSV with one; gzip is fine.

    **A pair** is a maximal run of consecutive frames in which one vehicle has the same leader
    (`Preceding`) in the same lane. Only frames count at which the leader's own row exists, in the
    same lane, with its rear bumper ahead of the follower's front; any other frame ends the run and
    is counted. Positions are `Local_Y`, speeds and accelerations `v_Vel` and `v_Acc` as recorded;
    1 ft = 0.3048 m exactly. Runs of a single frame are no pairs.

    **Recordings.** A file may hold several, in which vehicle ids and frames start anew. Each row's
    `Global_Time - 100 ms * Frame_ID` is the instant at which its recording's frame 0 lies, the same
    for all its rows: rows whose instants differ by more than a minute are of different recordings,
    even if these overlap in time. They are named `LOCATION-1`, `LOCATION-2` in order of time
    (`LOCATION` if there is one alone; the file's name stands in where there is no `Location`
    column). Without a usable clock (no `Global_Time`, or one that a spreadsheet has rounded) each
    location counts as one recording. The site is the `Location`; without that column, the location
    that was recorded on the day of `Global_Time` (13 April 2005: i-80; 15 June: us-101; 16 June:
    lankershim; 8 November 2006: peachtree).

    **Several files** hold several recordings, as NGSIM's own downloads do. Where two of them call
    theirs alike, as all three of I-80 are `i-80`, the file's name is put before the recording's.

    **Thinned files** have every second frame alone, or number theirs anew, and the clock then says
    how long a step is.

    **Boundary artefacts of smoothing** (M. Montanino and V. Punzo 2015, Trajectory data
    reconstruction and simulation-based validation against macroscopic traffic patterns,
    Transportation Research Part B 80, treat the errors of these recordings). In NGSIM's I-80 as
    published, vehicles seem to speed up by some 1 m/s2 during the first three seconds of their
    rows, and to slow down as much during the last three: all of them, wherever they are, as
    smoothing over too few rows does. A driver who follows such a leader seems to foresee it, and a
    policy learns that. Where a file is like that, the log says so; `trim=3` leaves these rows out,
    and counts them.

    **Duplicates.** Rows that agree in every column read here are counted and dropped, as real
    exports hold some; rows that contradict each other are an error.

    In the opposite direction of an arterial `Local_Y` decreases; such frames count as "leader
    behind its follower".
    """

    layout = "NGSIM (feet)"
    schema: ClassVar[type[Settings]] = NgsimSettings
    settings: NgsimSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        plain = {re.sub(r"[^a-z]", "", name.lower()) for name in start.columns}
        return len(plain & {"vehicleid", "frameid", "localy", "vvel"}) >= 2

    def units(self) -> Mapping[str, str]:
        return _UNITS

    def read(self) -> PairSet:
        return self._pairs(self._rows())

    def contents(self) -> Contents:
        files = self._rows()
        problems = [rows.boundary_artefacts() for rows in files]
        return Contents(
            self._pairs(files),
            sum(rows.rows_read for rows in files),
            sum(rows.vehicles for rows in files),
            "; ".join(problem for problem in problems if problem),
        )

    def _rows(self) -> list[Rows]:
        """Returns the rows of each file."""
        return [read_ngsim(path, self.settings.location) for path in self.settings.files()]

    def _pairs(self, files: Sequence[Rows]) -> PairSet:
        parts = []
        for rows in _with_different_names(files):
            if self.settings.trim:
                parts.append(rows.trimmed(self.settings.trim).pairs())
                continue
            artefacts = rows.boundary_artefacts()
            if artefacts:
                log.info("%s: %s", rows.source, artefacts)
            parts.append(rows.pairs())
        return joined(parts)


def _with_different_names(parts: Sequence[Rows]) -> list[Rows]:
    """Returns the rows of several files; no two recordings have the same name.

    Vehicles' ids start anew in each recording.

    Raises:
        DataError: two of the files are named alike, too.
    """
    counts: Counter[str] = Counter()
    for rows in parts:
        counts.update(rows.recordings)
    files: dict[str, str] = {}
    result = []
    for rows in parts:
        names = []
        for recording in rows.recordings:
            name = _name_in(rows, recording, is_shared=counts[recording] > 1)
            if name in files:
                raise DataError(
                    f"{files[name]} and {rows.source}: both recordings would be called '{name}';"
                    " rename one of the files"
                )
            names.append(name)
        files |= dict.fromkeys(names, rows.source)
        result.append(replace(rows, recordings=tuple(names)))
    return result


def _name_in(rows: Rows, name: str, *, is_shared: bool) -> str:
    """Returns a recording's name; the file's stands before one that several files share."""
    file = stem(Path(rows.source))
    if not is_shared:
        return name
    if name == file:
        return file
    return f"{file}-{name}"
