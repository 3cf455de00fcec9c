"""OpenACC: platoons of cars with adaptive cruise control, and of human drivers, at 10 Hz.

M. Makridis, K. Mattas, A. Anesiadou and B. Ciuffo (2021), OpenACC. An open database of
car-following experiments to study the properties of commercial ACC systems, Transportation Research
Part C 125, 103047. European Commission, Joint Research Centre; CC BY 4.0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np

from cfx.errors import DataError, listed
from cfx.plugin import (
    Contents,
    Dataset,
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
    beginning,
    joined,
    read_table,
    stem,
)
from cfx_recordings.series import Series, frames_at, pairs_of

_Column = TypeVar("_Column", Floats, NameColumn)

DT = 0.1
"""Seconds between two rows of every campaign."""

_LINES = 5
"""Lines of metadata above the table."""

_KEYS = ("Date", "Vehicle_order", "Number_of_vehicles", "ACC", "Distance_setting")

_HUMAN, _ACC = "human", "acc"

_TYPE_OF_FLAG = {"0": _HUMAN, "1": _ACC}
"""What `ACC` above the table says of all followers; 2 is mixed, empty is not known."""


_LAYOUT = Layout(
    "OpenACC",
    (
        FileColumn("Time", "s"),
        FileColumn(r"Speed\d+", "m/s", many=True, needed=False, may_be_empty=True),
        FileColumn(r"IVS\d+", "m", many=True, needed=False, may_be_empty=True),
        FileColumn(r"Driver\d+", is_name=True, many=True, needed=False, may_be_empty=True),
    ),
    above=_LINES,
)


class OpenaccDataset(Dataset):
    """Pairs from OpenACC's CSV files: five lines about the experiment, then a table.

    Each vehicle k of a platoon has its columns `Speedk`, `Ek`, ...; `IVSk` is the bumper-to-bumper
    distance between vehicle k and the one behind it, k + 1. Columns are found by their names, as
    campaigns have different ones in different orders. A pair needs `Speedk`, `Speed(k+1)` and
    `IVSk`.

    **Positions.** Cars are located by satellite on roads that bend, so positions are made of what
    was measured along the road: the leader's is the distance that its speed gives, the follower's
    is that less the gap (`series.py`). Lengths are not recorded, and are 0: positions of leaders
    are those of rear bumpers. Accelerations are central differences of the speeds, which most
    campaigns left unfiltered.

    **Labels.** `driver_type` is human or acc, from the follower's `Driver` column, or, where a file
    has none, from its line `ACC` (0 or 1). A pair is cut where the driver hands over.
    `leader_driver_type` is the leader's, where it is the same in the whole file, else "".

    **Cuts.** Rows with empty cells, negative speeds, gaps of 0 or less, and missing times (tunnels,
    toll stations) end a pair and are counted.

    **Drivers.** A recording is one file, and a site the folder that it lies in: campaigns are
    published in folders. The same car drives in many files, under its name in `Vehicle_order`: with
    cruise control it is one driver in all of them, and without another one.
    """

    layout = "OpenACC (SI units)"
    schema: ClassVar[type[Settings]] = FileDatasetSettings
    settings: FileDatasetSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        if len(start.lines) <= _LINES:
            return False
        names = {_cells(line)[0] for line in start.lines[:_LINES]}
        return len(names & set(_KEYS)) >= 3

    def read(self) -> PairSet:
        return self.contents().pairs

    def contents(self) -> Contents:
        files = [_read(path) for path in self.settings.files()]
        vehicles = sum(len(file.speeds) for file in files)
        rows = sum(len(file.frame) for file in files)
        pairs = joined([_pairs(file) for file in files])
        return Contents(pairs, rows, vehicles, has_gaps=True)


def _cells(line: str) -> list[str]:
    """Returns the cells of a line above the table."""
    return [cell.strip() for cell in re.split("[,;\t|]", line)]


class _File(NamedTuple):
    """One experiment.

    Attributes:
        about: what stands above the table, by its name in small letters.
        frame: of each row `(N,)`.
        speeds: by the vehicle's place in the platoon.
        gaps: to the vehicle behind, by the place of the one ahead.
        drivers: labels, by place, where there are any.
    """

    path: Path
    about: Mapping[str, Sequence[str]]
    frame: Ints
    speeds: Mapping[int, Floats]
    gaps: Mapping[int, Floats]
    drivers: Mapping[int, NameColumn]


def _read(path: Path) -> _File:
    start = beginning(path)
    if not OpenaccDataset.recognises(start):
        raise DataError(
            f"{path}: is no OpenACC file: five lines must stand above its table: {listed(_KEYS)}"
        )
    about = {}
    for line in start.lines[:_LINES]:
        key, *values = _cells(line)
        about[key.lower()] = [value for value in values if value]
    table = read_table(path, _LAYOUT)
    _check_time(table)
    return _File(
        path,
        about,
        frames_at(table.numbers["Time"], DT, str(path)),
        _by_place(table.numbers, "Speed"),
        _by_place(table.numbers, "IVS"),
        _by_place(table.labels, "Driver"),
    )


def _by_place(columns: Mapping[str, _Column], kind: str) -> dict[int, _Column]:
    """Returns the columns of a kind, such as Speed1 and Speed2, by the vehicle's place."""
    by_place = {}
    for name, values in columns.items():
        if name.startswith(kind):
            by_place[int(name.removeprefix(kind))] = values
    return by_place


def _check_time(table: Table) -> None:
    """Raises DataError unless times advance, on a grid of 0.1 s."""
    time = table.numbers["Time"]
    goes_back = np.append(False, np.diff(time) <= 0)
    table.refuse("Time", goes_back, "does not advance from the row before")
    at = (time - time[0]) / DT
    between = f"s is between two frames of {DT:g} s; OpenACC's rows are {DT:g} s apart"
    table.refuse("Time", np.abs(at - np.rint(at)) > 0.25, between)


def _pairs(file: _File) -> PairSet:
    series = []
    for ahead in sorted(file.gaps):
        behind = ahead + 1
        if ahead in file.speeds and behind in file.speeds:
            series.append(_series(file, ahead, behind))
    if not series:
        raise DataError(
            f"{file.path}: no two vehicles have Speed and IVS columns; columns IVS found for"
            f" vehicles {listed(sorted(file.gaps)) or 'none'}, Speed for"
            f" {listed(sorted(file.speeds)) or 'none'}"
        )
    return pairs_of(series, str(file.path))


def _series(file: _File, ahead: int, behind: int) -> Series:
    leader, follower = _name(file, ahead), _name(file, behind)
    codes, types = _driver(file, behind)
    _, leader_types = _driver(file, ahead)
    stated = [driver_type for driver_type in leader_types if driver_type]
    return Series(
        name=f"{stem(file.path)}-{follower}-{leader}",
        recording=stem(file.path),
        leader_id=leader,
        follower_id=follower,
        dt=DT,
        frame=file.frame,
        signals={"leader_speed": file.speeds[ahead], "follower_speed": file.speeds[behind]},
        gap=file.gaps[ahead],
        labels={"driver_type": codes},
        driver_types=types,
        leader_driver_type=stated[0] if len(stated) == 1 else "",
        site=file.path.absolute().parent.name,
        vehicle=_car(file, behind),
    )


def _name(file: _File, place: int) -> str:
    """Returns a vehicle's name: its place in the platoon, and what the file calls it."""
    car = _car(file, place)
    return f"{place}-{car}" if car else str(place)


def _car(file: _File, place: int) -> str:
    """Returns what the file calls the car at a place in the platoon, "" if nothing."""
    order = file.about.get("vehicle_order", [])
    return order[place - 1] if place <= len(order) else ""


def _driver(file: _File, place: int) -> tuple[Ints, list[str]]:
    """Returns who drives at each row `(N,)`, an index into the types, and the types."""
    labels = file.drivers.get(place)
    if labels is not None and labels.names:
        types = [name.lower() for name in labels.names]
        return np.where(labels.codes < 0, len(types), labels.codes), [*types, ""]
    flag = "".join(file.about.get("acc", [])[:1])
    kind = ""
    if place > min(file.speeds):
        kind = _TYPE_OF_FLAG.get(flag, "")
    return np.zeros(len(file.frame), dtype=np.int64), [kind]
