"""highD: drone recordings of German motorways, at 25 Hz.

R. Krajewski, J. Bock, L. Kloeker and L. Eckstein (2018), The highD Dataset, IEEE ITSC, 2118-2125.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cfx.errors import DataError
from cfx.plugin import (
    Dataset,
    FileColumn,
    FileDatasetSettings,
    FileStart,
    Floats,
    Ints,
    Layout,
    PairSet,
    Settings,
    Table,
    Tracks,
    extract_pairs,
    joined,
    read_table,
    statements,
    tracks,
    with_sites,
)

_PACKINGS = ("", ".gz", ".zip", ".zst", ".xz", ".bz2")
"""Endings of files that are read unpacked."""

_TRACKS, _TRACKS_META, _RECORDING_META = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"


def _count(name: str) -> FileColumn:
    return FileColumn(name, whole=True, least=0, wrong="is no whole number from 0 on")


_TWICE = {"dhw": "m", "thw": "s", "ttc": "s", "precedingXVelocity": "m/s"}
"""Columns that follow from others: they are compared with these where they are there."""

_CLOSING_MPS = 0.2
"""From this relative speed on, which has two decimals, a time to collision says something."""

_TRACK_COLUMNS = Layout(
    "highD's tracks",
    (
        _count("frame"),
        _count("id"),
        FileColumn("x", "m"),
        FileColumn("width", "m", above=0, wrong="is no vehicle length"),
        FileColumn("xVelocity", "m/s"),
        FileColumn("xAcceleration", "m/s2"),
        _count("precedingId"),
        _count("laneId"),
        *[FileColumn(name, unit, needed=False, may_be_empty=True) for name, unit in _TWICE.items()],
    ),
)
_VEHICLE_COLUMNS = Layout(
    "highD's vehicles",
    (
        FileColumn("id"),
        FileColumn("drivingDirection"),
        FileColumn("class", is_name=True, may_be_empty=True),
    ),
)
_RECORDING_COLUMNS = Layout(
    "highD's recordings",
    (
        FileColumn("frameRate", "1/s", above=0, wrong="is no frame rate"),
        FileColumn("locationId", is_name=True, needed=False, may_be_empty=True),
    ),
)

_LEFT, _RIGHT = 1, 2
"""Driving directions: the upper lanes lead to the left, the lower ones to the right."""


class HighdSettings(FileDatasetSettings):
    """Which part of a highD recording to read."""

    max_gap: float | None = Field(
        120.0, gt=0, description="m: farther vehicles are no leaders; null: all are"
    )


class HighdDataset(Dataset):
    """Pairs from highD's files: `XX_tracks.csv`, with its `_tracksMeta` and `_recordingMeta`.

    `data.path` names the tracks; the other two files lie beside them under the same number.

    **Pairs** are cut by `cfx.data.tracks.extract_pairs`: the leader is `precedingId` (0 is
    none), in the same `laneId`.

    **Positions.** `x` is the left edge of a vehicle's box and `width` its length along the road;
    both directions have one axis. The front bumper of a vehicle that drives to the right
    (`drivingDirection` 2) is at `x + width`, and its position grows with x. That of one that drives
    to the left (1) is at `x`, and its position is `-x`; its speed and acceleration are `-xVelocity`
    and `-xAcceleration`.

    **NameColumn.** `driver_type` and `leader_driver_type` are the vehicles' `class`: car or truck.

    The recordings are called `highd-XX`, and sites `highd-location-N` by the `locationId` of the
    recording's metadata (six stretches of motorway). Vehicles are seen for some 14 s only, so pairs
    are short: `data.time_step=0.1` gives them at 10 Hz, the step of NGSIM.
    """

    layout = "highD tracks (m, 25 Hz)"
    schema: ClassVar[type[Settings]] = HighdSettings
    settings: HighdSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        return start.has_columns("frame", "id", "xVelocity", "precedingId")

    def read(self) -> PairSet:
        parts = []
        for path in self.settings.files():
            about = read_table(_beside(path, _RECORDING_META), _RECORDING_COLUMNS)
            pairs = extract_pairs(_tracks(path, about), max_gap=self.settings.max_gap)
            parts.append(with_sites(pairs, _site(about)))
        return joined(parts)


class _Vehicles(NamedTuple):
    """What the meta file says of each vehicle, `(V,)` each, by ascending id."""

    vehicle: Ints
    direction: Ints
    kind: Ints
    kinds: tuple[str, ...]


def _site(about: Table) -> str | None:
    """Returns the stretch of motorway that a recording's metadata name; None if they do not."""
    place = about.labels["locationId"].at(0) if "locationId" in about.labels else ""
    return f"highd-location-{place}" if place else None


def _tracks(path: Path, about: Table) -> Tracks:
    """Reads one recording.

    Args:
        path: of the tracks.
        about: the recording's metadata.

    Raises:
        DataError: a file is missing or does not keep to the layout.
    """
    table = read_table(path, _TRACK_COLUMNS)
    numbers = table.numbers
    vehicles = _vehicles(_beside(path, _TRACKS_META))
    row_of = np.searchsorted(vehicles.vehicle, numbers["id"])
    row_of[row_of == len(vehicles.vehicle)] = 0
    is_unknown = vehicles.vehicle[row_of] != numbers["id"]
    what = f"is no vehicle of {_beside(path, _TRACKS_META).name}; both must be of one recording"
    table.refuse("id", is_unknown, what)
    to_right = vehicles.direction[row_of] == _RIGHT
    sign = np.where(to_right, 1.0, -1.0)
    speed = sign * numbers["xVelocity"]
    _check(table, speed)
    order = np.lexsort((numbers["frame"], numbers["id"]))
    front = np.where(to_right, numbers["x"] + numbers["width"], -numbers["x"])
    drives = Tracks(
        source=str(path),
        dt=1.0 / float(about.numbers["frameRate"][0]),
        recordings=(f"highd-{path.name.partition(_TRACKS)[0]}",),
        recording=np.zeros(len(order), dtype=np.int64),
        vehicle=table.whole("id")[order],
        frame=table.whole("frame")[order],
        lane=table.whole("laneId")[order],
        leader=table.whole("precedingId")[order],
        position=front[order],
        speed=np.maximum(speed, 0.0)[order],
        acceleration=(sign * numbers["xAcceleration"])[order],
        length=numbers["width"][order],
        driver_type=vehicles.kind[row_of][order],
        driver_types=vehicles.kinds,
    )
    frame, apart = tracks.frames_apart(str(path), drives.recording, drives.vehicle, drives.frame)
    drives = replace(drives, frame=frame, dt=drives.dt * apart)
    said = {name: numbers[name][order] for name in _TWICE if name in numbers}
    return replace(drives, remarks=statements.remarks_of(_said_twice(drives, said)))


def _said_twice(vehicles: Tracks, said: Mapping[str, Floats]) -> Iterator[statements.Statement]:
    """Yields what columns say that follows from others too; 0 stands where nobody is ahead."""
    ahead, has_row = tracks.rows_ahead(vehicles)
    headway = np.where(has_row, vehicles.position[ahead] - vehicles.position, np.nan)
    if "precedingXVelocity" in said:
        speed = np.where(has_row, vehicles.speed[ahead], np.nan)
        leaders = np.abs(said["precedingXVelocity"])
        yield statements.Statement(
            "precedingXVelocity", leaders, [speed], "the leader's xVelocity", 0.02
        )
    if "dhw" not in said:
        return
    gap = headway - vehicles.length[ahead]
    yield statements.Statement(
        "dhw", said["dhw"], [headway, gap], "x and width of a vehicle and its leader"
    )
    moves = np.where(vehicles.speed > 0, vehicles.speed, np.nan)
    if "thw" in said:
        yield statements.Statement(
            "thw", said["thw"], [said["dhw"] / moves], "dhw and xVelocity", 0.02
        )
    if "ttc" in said:
        closing = np.abs(np.where(has_row, vehicles.speed - vehicles.speed[ahead], np.nan))
        until = said["dhw"] / np.where(closing > _CLOSING_MPS, closing, np.nan)
        basis = "dhw and xVelocity of a vehicle and its leader"
        yield statements.Statement("ttc", np.abs(said["ttc"]), [until], basis, 0.02)


def _beside(path: Path, ending: str) -> Path:
    """Returns another file of the same recording.

    Raises:
        DataError: the tracks are not named as highD's, or there is no such file.
    """
    number, separator, packing = path.name.partition(_TRACKS)
    if not separator or packing not in _PACKINGS:
        raise DataError(
            f"{path}: highD's tracks are named XX{_TRACKS}; give this file, with"
            f" XX{_TRACKS_META} and XX{_RECORDING_META} beside it"
        )
    for packing in _PACKINGS:
        other = path.with_name(number + ending + packing)
        if other.is_file():
            return other
    raise DataError(
        f"{path.with_name(number + ending)}: no such file; it must lie beside {path.name}"
    )


def _vehicles(path: Path) -> _Vehicles:
    table = read_table(path, _VEHICLE_COLUMNS)
    direction = table.numbers["drivingDirection"]
    is_odd = (direction != _LEFT) & (direction != _RIGHT)
    table.refuse("drivingDirection", is_odd, f"is neither {_LEFT} nor {_RIGHT}")
    order = np.argsort(table.numbers["id"])
    labels = table.labels["class"]
    return _Vehicles(
        table.whole("id")[order],
        table.whole("drivingDirection")[order],
        labels.codes[order],
        (*[name.lower() for name in labels.names], ""),
    )


_REVERSE_MPS = 0.5
"""Speeds against the driving direction up to this are noise of vehicles that stand."""


def _check(table: Table, speed: Floats) -> None:
    """Raises DataError for what no such recording can hold.

    Args:
        speed: along the driving direction, m/s.
    """
    against = "is against the vehicle's drivingDirection; are both files of the same recording?"
    table.refuse("xVelocity", speed < -_REVERSE_MPS, against)
    frame = table.numbers["frame"]
    key = table.numbers["id"] * (frame.max() + 1) + frame
    if len(np.unique(key)) < len(key):
        raise DataError(f"{table.source}: a vehicle has two rows at one frame; keep one of them")
