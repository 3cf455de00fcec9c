"""Reading NGSIM's files: their columns, whatever they are called, and the recordings in them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.core.errors import DataError, nearest
from cfx.data.base import listed
from cfx.data.files import (
    PARQUET,
    Floats,
    Ints,
    Labels,
    TextTable,
    bad_cells,
    magic,
    read_columns,
    sniff,
    stem,
)
from cfx.data.ngsim_rows import DT, FOOT, Rows
from cfx.data.pairs import Dropped
from cfx.data.tracks import changes

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

LAYOUTS = {
    18: (*_BEFORE_ZONES, *_AFTER_ZONES),
    24: (*_BEFORE_ZONES, *_ZONES, *_AFTER_ZONES),
}
"""Columns of a file without a header, by their number: motorways, and arterials (Lankershim)."""

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
"""Columns that are needed, by their published names."""

_WHOLE = ("Vehicle_ID", "Frame_ID", "Lane_ID", "Preceding")
"""Those of them that hold whole numbers."""

_CLOCK, _LOCATION = "Global_Time", "Location"
"""Columns that are used where they are there."""

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
"""Other names of columns that exports have, as `_plain` writes them."""

_NEW_RECORDING_MS = 60_000.0
"""Two recordings of a place start at least this far apart.

Within one recording the clock and the frame count agree far better.
"""

_FRAME_MS = 1000 * DT

_DRIVING_MPS = 1.0
"""Below it, noise of positions hides how far a vehicle moves in a frame."""


def read_ngsim(path: Path, location: str | None = None) -> Rows:
    """Reads an NGSIM file.

    Args:
        location: keep the rows of this location alone.

    Raises:
        DataError: see `NgsimDataset`; the message names file, row and column.
    """
    if magic(path) == PARQUET:
        raise DataError(
            f"{path}: is a parquet file; NGSIM publishes text."
            " Pairs in the tidy layout are read with data=tidy"
        )
    table = sniff(path)
    positions = _columns(table)
    place = {}
    if _LOCATION in positions:
        place[_LOCATION] = positions.pop(_LOCATION)
    numbers, labels = read_columns(table, positions, place)
    count = len(numbers["Vehicle_ID"])
    if not count:
        raise DataError(f"{path}: has a header but no rows")
    where = labels.get(_LOCATION) or Labels(np.zeros(count, np.int64), [stem(path)])
    _check(table, numbers, where)

    dropped = []
    row = np.arange(count)
    if location is not None:
        row = np.flatnonzero(where.codes == _location_code(table, where, location))
        if len(row) < count:
            reason = f"other locations than '{location}'"
            dropped.append(Dropped(reason, count - len(row), "rows"))
    columns = {name: values[row] for name, values in numbers.items()}
    recording, names = _recordings(columns, where.codes[row], where.names)
    order, again = _sorted(table, columns, recording, row)
    if again:
        dropped.append(Dropped("the same row again", again, "rows"))
    ordered = {name: values[order] for name, values in columns.items()}
    rows = _rows(str(path), names, recording[order], ordered, count, dropped)
    _check_units(rows)
    return rows


def _rows(
    source: str,
    names: tuple[str, ...],
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
        length=_lengths(columns["v_Length"], recording, vehicle) * FOOT,
        rows_read=count,
        dropped=tuple(dropped),
    )


def _plain(name: str) -> str:
    """Returns a column's name in lower case without separators, in one of its spellings."""
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return _SPELLINGS.get(plain, plain)


def _columns(table: TextTable) -> dict[str, int]:
    """Returns the position of each column wanted, by its published name."""
    names: Sequence[str] | None = table.header
    if names is None:
        names = LAYOUTS.get(table.width)
        if names is None:
            raise DataError(
                f"{table.path}: its first row has {table.width} columns;"
                " NGSIM's files without a header have 18 (arterials: 24)"
            )
    found: dict[str, int] = {}
    for at, name in enumerate(names):
        found.setdefault(_plain(name), at)
    for name in _NUMBERS:
        if _plain(name) not in found:
            raise DataError(_missing(table, name, names, found))
    positions = {}
    for name in (*_NUMBERS, _CLOCK, _LOCATION):
        if _plain(name) in found:
            positions[name] = found[_plain(name)]
    return positions


def _missing(table: TextTable, name: str, names: Sequence[str], found: Mapping[str, int]) -> str:
    """Returns what to say of a column that is not there."""
    text = f"{table.path}: column {name} is missing."
    if len(names) > 1:
        text += nearest(name, names)
    if "pairid" in found:
        text += " This is the tidy pair layout: use data=tidy."
    return f"{text} Columns found: {listed(names, 30)}."


def _check(table: TextTable, numbers: Mapping[str, Floats], where: Labels) -> None:
    """Raises DataError for the first cell that no recording can hold."""
    for name, values in numbers.items():
        bad = bad_cells(values)
        if bad is not None:
            index, count, what = bad
            raise DataError(
                f"{table.path}, row {table.row(index)}, column {name}: the cell is {what}"
                f" ({count} such cells in this column); correct it or remove the row"
            )
    for name in _WHOLE:
        values = numbers[name]
        is_wrong = (values != np.floor(values)) | (values < 0)
        _reject(table, numbers, name, is_wrong, "is no whole number")
    _reject(table, numbers, "v_Vel", numbers["v_Vel"] < 0, "is negative: a speed cannot be")
    _reject(table, numbers, "v_Length", numbers["v_Length"] <= 0, "is no vehicle length")
    nowhere = np.flatnonzero(where.codes < 0)
    if len(nowhere):
        raise DataError(
            f"{table.path}, row {table.row(nowhere[0])}, column {_LOCATION}: the cell is empty;"
            " correct it"
        )


def _reject(
    table: TextTable, numbers: Mapping[str, Floats], name: str, wrong: NDArray[np.bool_], why: str
) -> None:
    """Raises DataError if any cell of a column is wrong; names the first."""
    at = np.flatnonzero(wrong)
    if len(at):
        raise DataError(
            f"{table.path}, row {table.row(at[0])}, column {name}: {numbers[name][at[0]]:g} {why}"
            f" ({len(at)} such cells); correct it"
        )


def _location_code(table: TextTable, where: Labels, location: str) -> int:
    """Returns the index of a location in `where.names`."""
    for code, name in enumerate(where.names):
        if name.lower() == location.lower():
            return code
    raise DataError(
        f"data.location={location}: {table.path} has no such location."
        f"{nearest(location, where.names)} Known: {listed(where.names)}."
    )


def _recordings(
    columns: Mapping[str, Floats], location: Ints, names: Sequence[str]
) -> tuple[Ints, tuple[str, ...]]:
    """Returns the recording of each row and the recordings' names: see `NgsimDataset`.

    Args:
        columns: of the file.
        location: of each row `(N,)`, an index into `names`.
        names: of the locations.

    Returns:
        An index `(N,)` into the names of recordings, and these names.
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
    return recording, tuple(recordings)


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
    """Returns the order by recording, vehicle and frame, and how many duplicates it leaves out.

    Raises:
        DataError: a vehicle has two different rows at a frame.
    """
    order = np.lexsort((columns["Frame_ID"], columns["Vehicle_ID"], recording))
    is_same = ~changes(recording[order], columns["Vehicle_ID"][order], columns["Frame_ID"][order])
    again = np.flatnonzero(is_same)
    before, after = order[again - 1], order[again]
    differs = np.zeros(len(again), dtype=bool)
    for values in columns.values():
        differs |= values[before] != values[after]
    if differs.any():
        first, second = before[differs][0], after[differs][0]
        a, b = sorted((row[first], row[second]))
        vehicle, frame = columns["Vehicle_ID"][second], columns["Frame_ID"][second]
        raise DataError(
            f"{table.path}, rows {table.row(a)} and {table.row(b)}: vehicle {vehicle:.0f} has two"
            f" different rows at frame {frame:.0f} ({int(differs.sum())} such pairs of rows); keep"
            " one of them, or, if the file holds several recordings, give it Global_Time in"
            " milliseconds so that they can be told apart"
        )
    return order[~is_same], len(again)


def _lengths(length: Floats, recording: Ints, vehicle: Ints) -> Floats:
    """Returns each vehicle's median length at each of its rows."""
    group = np.cumsum(changes(recording, vehicle))
    medians: Floats = pd.Series(length).groupby(group).transform("median").to_numpy()
    return medians


def _check_units(rows: Rows) -> None:
    """Raises DataError if lengths, or positions and speeds, seem not to be in feet."""
    typical = float(np.median(rows.length)) / FOOT
    if typical < 8:
        raise DataError(
            f"{rows.source}, column v_Length: vehicles are typically {typical:.1f} long, which"
            " looks like metres; NGSIM's files are in feet. Convert the file back, or write its"
            " pairs in the tidy layout (SI units) and use data=tidy"
        )
    is_step = (
        ~changes(rows.recording, rows.vehicle)[1:]
        & (np.diff(rows.frame) == 1)
        & (rows.speed[1:] > _DRIVING_MPS)
    )
    if not is_step.any():
        return
    moved = np.abs(np.diff(rows.position)[is_step])
    ratio = float(np.median(moved / (rows.speed[1:][is_step] * DT)))
    if not 0.8 < ratio < 1.25:
        raise DataError(
            f"{rows.source}, columns Local_Y and v_Vel: from frame to frame vehicles typically"
            f" advance by {ratio:.3g} times their speed times 0.1 s; both columns must be in feet"
            " (ft and ft/s)"
        )
