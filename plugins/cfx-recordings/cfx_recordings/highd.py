"""highD: drone recordings of German motorways, at 25 Hz.

R. Krajewski, J. Bock, L. Kloeker and L. Eckstein (2018), The highD Dataset, IEEE ITSC, 2118-2125.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cfx import PairSet, Settings
from cfx.core.errors import DataError
from cfx.data.base import Dataset, FileDatasetSettings, joined
from cfx.data.files import FileStart, Floats, Ints, TextTable, read_columns
from cfx.data.tracks import Tracks, extract_pairs
from cfx_recordings.tables import position, read_numbers, refuse

_TRACKS, _TRACKS_META, _RECORDING_META = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"

_COLUMNS = (
    "frame",
    "id",
    "x",
    "width",
    "xVelocity",
    "xAcceleration",
    "precedingId",
    "laneId",
)
"""Columns of the tracks that are read."""

_LEFT, _RIGHT = 1, 2
"""Driving directions: the upper lanes lead to the left, the lower ones to the right."""


class HighdSettings(FileDatasetSettings):
    """Which part of a highD recording to read."""

    min_frames: int = Field(
        375, ge=2, description="shortest pair that is kept, frames; 375 are 15 s at 25 Hz"
    )
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

    **Labels.** `driver_type` and `leader_driver_type` are the vehicles' `class`: car or truck.

    The recordings are called `highd-XX`. Vehicles are seen for some 14 s only, so pairs are short:
    `data.time_step=0.1 data.min_frames=150` gives them at 10 Hz, the step of NGSIM.
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
            parts.append(extract_pairs(_tracks(path), max_gap=self.settings.max_gap))
        return joined(parts)


class _Vehicles(NamedTuple):
    """What the meta file says of each vehicle, `(V,)` each, by ascending id."""

    vehicle: Ints
    direction: Ints
    kind: Ints
    kinds: tuple[str, ...]


def _tracks(path: Path) -> Tracks:
    """Reads one recording.

    Raises:
        DataError: a file is missing or does not keep to the layout.
    """
    numbers, table = read_numbers(path, [(name,) for name in _COLUMNS])
    vehicles = _vehicles(_beside(path, _TRACKS_META))
    row_of = np.searchsorted(vehicles.vehicle, numbers["id"])
    row_of[row_of == len(vehicles.vehicle)] = 0
    is_unknown = vehicles.vehicle[row_of] != numbers["id"]
    what = f"is no vehicle of {_beside(path, _TRACKS_META).name}; both must be of one recording"
    refuse(table, "id", numbers["id"], is_unknown, what)
    to_right = vehicles.direction[row_of] == _RIGHT
    sign = np.where(to_right, 1.0, -1.0)
    speed = sign * numbers["xVelocity"]
    _check(table, numbers, speed)
    order = np.lexsort((numbers["frame"], numbers["id"]))
    whole = {name: numbers[name][order].astype(np.int64) for name in ("id", "frame", "laneId")}
    front = np.where(to_right, numbers["x"] + numbers["width"], -numbers["x"])
    return Tracks(
        source=str(path),
        dt=1.0 / _frame_rate(_beside(path, _RECORDING_META)),
        recordings=(f"highd-{path.name.removesuffix(_TRACKS)}",),
        recording=np.zeros(len(order), dtype=np.int64),
        vehicle=whole["id"],
        frame=whole["frame"],
        lane=whole["laneId"],
        leader=numbers["precedingId"][order].astype(np.int64),
        position=front[order],
        speed=np.maximum(speed, 0.0)[order],
        acceleration=(sign * numbers["xAcceleration"])[order],
        length=numbers["width"][order],
        driver_type=vehicles.kind[row_of][order],
        driver_types=vehicles.kinds,
    )


def _beside(path: Path, ending: str) -> Path:
    """Returns another file of the same recording.

    Raises:
        DataError: the tracks are not named as highD's, or there is no such file.
    """
    if not path.name.endswith(_TRACKS):
        raise DataError(
            f"{path}: highD's tracks are named XX{_TRACKS}; give this file, with"
            f" XX{_TRACKS_META} and XX{_RECORDING_META} beside it"
        )
    other = path.with_name(path.name.removesuffix(_TRACKS) + ending)
    if not other.is_file():
        raise DataError(f"{other}: no such file; it must lie beside {path.name}")
    return other


def _vehicles(path: Path) -> _Vehicles:
    numbers, table = read_numbers(path, [("id",), ("drivingDirection",)])
    _, labels = read_columns(table, {}, {"class": position(table, "class")})
    direction = numbers["drivingDirection"]
    is_odd = (direction != _LEFT) & (direction != _RIGHT)
    refuse(table, "drivingDirection", direction, is_odd, f"is neither {_LEFT} nor {_RIGHT}")
    order = np.argsort(numbers["id"])
    kinds = (*[name.lower() for name in labels["class"].names], "")
    return _Vehicles(
        numbers["id"][order].astype(np.int64),
        direction[order].astype(np.int64),
        labels["class"].codes[order],
        kinds,
    )


def _frame_rate(path: Path) -> float:
    """Returns frames per second."""
    numbers, _ = read_numbers(path, [("frameRate",)])
    rate = float(numbers["frameRate"][0])
    if not rate > 0:
        raise DataError(f"{path}, column frameRate: {rate:g} is no frame rate")
    return rate


_REVERSE_MPS = 0.5
"""Speeds against the driving direction up to this are noise of vehicles that stand."""


def _check(table: TextTable, numbers: dict[str, Floats], speed: Floats) -> None:
    """Raises DataError for what no such recording can hold.

    Args:
        speed: along the driving direction, m/s.
    """
    for name in ("frame", "id", "precedingId", "laneId"):
        values = numbers[name]
        is_odd = (values != np.floor(values)) | (values < 0)
        refuse(table, name, values, is_odd, "is no whole number from 0 on")
    against = "is against the vehicle's drivingDirection; are both files of the same recording?"
    refuse(table, "xVelocity", numbers["xVelocity"], speed < -_REVERSE_MPS, against)
    refuse(table, "width", numbers["width"], numbers["width"] <= 0, "is no vehicle length")
    key = numbers["id"] * (numbers["frame"].max() + 1) + numbers["frame"]
    if len(np.unique(key)) < len(key):
        raise DataError(f"{table.path}: a vehicle has two rows at one frame; keep one of them")
