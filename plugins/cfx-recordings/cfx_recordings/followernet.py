"""FollowNet's event arrays: spacing, speed, relative speed and leader's speed over time.

X. Chen, M. Zhu, K. Chen et al. (2023), FollowNet: A comprehensive benchmark for car-following
behavior modeling, Scientific Data 10, 828; events of HighD, NGSIM, SPMD, Waymo and Lyft.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cfx.errors import DataError
from cfx.plugin import (
    Contents,
    Dataset,
    FileDatasetSettings,
    FileStart,
    Floats,
    PairSet,
    Settings,
    first_bytes,
    joined,
    stem,
)
from cfx_recordings.series import Series, pairs_of

_NPY, _ZIP, _MATLAB, _HDF = b"\x93NUM", b"PK\x03\x04", b"MATL", b"\x89HDF"

_ROWS = 4
_SPACING, _SPEED, _RELATIVE, _LEADER_SPEED = range(_ROWS)
"""Rows of an event."""

_UNPICKLE = (
    "its arrays are Python objects, which NumPy can only unpickle, and unpickling a file runs the"
    " code that is in it. If you trust it, convert it yourself: docs/readers.md has the five lines"
)


class FollowernetSettings(FileDatasetSettings):
    """What the arrays do not say of themselves."""

    recorded_step: float = Field(
        0.1,
        ge=0.001,
        le=2.0,
        description="s between two samples: 0.04 for HighD, 0.1 for the others; the file does not"
        " say it, but speeds and spacings show where it is wrong",
    )
    vehicle_length: float = Field(
        0.0,
        ge=0,
        le=100,
        description="m: taken off every spacing; 0 where it is bumper to bumper. In NGSIM's and"
        " Waymo's events it holds a vehicle's length (some 4.5 and 4.9 m)",
    )


class FollowernetDataset(Dataset):
    """Events from arrays `(events, 4, samples)` in an `.npy`, `.npz` or `.mat` file.

    The rows of an event are spacing, m; the follower's speed; the relative speed; the leader's
    speed, m/s. Events of different lengths are padded by NaN, or are arrays `(4, samples)` of their
    own in an `.npz` file, or in a cell array of a `.mat` file (version 7 or older).

    **Nothing is unpickled.** FollowNet's NGSIM, Waymo, Lyft and SPMD files are `.npy` files of
    Python objects. They are refused, since unpickling runs code; docs/readers.md shows how to
    convert a file that you trust.

    **Positions.** The leader's is the distance that its speed gives, the follower's is that less
    the gap; accelerations are central differences of speeds (`cfx_recordings.series`).

    **Drivers.** The events carry no ids. Each counts as a driver of its own, so drivers cannot be
    kept apart: in an evaluation on unseen drivers the same driver may be learned from and tested.
    """

    layout = "FollowNet events (SI units)"
    schema: ClassVar[type[Settings]] = FollowernetSettings
    settings: FollowernetSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        return any(_are_events(shape, is_number) for shape, is_number in _shapes(start))

    def read(self) -> PairSet:
        return self.contents().pairs

    def contents(self) -> Contents:
        parts = []
        rows = 0
        for path in self.settings.files():
            series = []
            for number, event in enumerate(_events(path), start=1):
                rows += event.shape[1]
                series.append(self._series(path, number, event))
            if not series:
                raise DataError(f"{path}: holds no events")
            parts.append(pairs_of(series, str(path)))
        pairs = joined(parts)
        problem = "events carry no drivers' ids: one driver may be learned from and tested"
        unnamed = "leaders and followers have no ids"
        return Contents(pairs, rows, 0, problem, has_gaps=True, unnamed=unnamed)

    def _series(self, path: Path, number: int, event: Floats) -> Series:
        recording = stem(path)
        speeds = event[_LEADER_SPEED] - event[_SPEED]
        if bool((np.abs(np.abs(speeds) - np.abs(event[_RELATIVE])) > 0.05).any()):
            raise DataError(
                f"{path}, event {number}: row 3 is not the difference of rows 4 and 2 (the leader's"
                " speed less the follower's); the rows of an event are spacing, speed, relative"
                " speed, leader's speed"
            )
        return Series(
            name=f"{recording}-{number}",
            recording=recording,
            leader_id=f"leader-{number}",
            follower_id=str(number),
            dt=self.settings.recorded_step,
            frame=np.arange(event.shape[1]),
            signals={"leader_speed": event[_LEADER_SPEED], "follower_speed": event[_SPEED]},
            gap=event[_SPACING] - self.settings.vehicle_length,
        )


def _are_events(shape: Sequence[int], is_number: bool) -> bool:
    """Says whether an array may hold events; of Python objects that is not known unopened."""
    if not is_number:
        return True
    return len(shape) in {2, 3} and shape[-2] == _ROWS


def _shapes(start: FileStart) -> Iterator[tuple[Sequence[int], bool]]:
    """Yields the shape of each array of a file, and whether it holds numbers; opens none of them.

    Other programs write such containers too.
    """
    if start.magic == _NPY:
        with start.path.open("rb") as file:
            yield from _header(file)
    elif start.magic == _ZIP:
        with zipfile.ZipFile(start.path) as archive:
            for name in archive.namelist():
                if name.endswith(".npy"):
                    with archive.open(name) as file:
                        yield from _header(file)
    elif start.magic == _MATLAB:
        from scipy.io import whosmat

        try:
            for _, shape, kind in whosmat(start.path):
                yield shape, kind not in {"cell", "struct", "object"}
        except (ValueError, NotImplementedError, TypeError, OSError):
            return  # it is damaged


def _header(file: IO[bytes]) -> Iterator[tuple[Sequence[int], bool]]:
    """Yields the shape of a NumPy array and whether it holds numbers; nothing if it is none."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, _, kind = read(file)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, RuntimeError):
        return
    yield shape, kind.kind in "fiu"


def _events(path: Path) -> Iterator[Floats]:
    """Yields the events of a file, `(4, T)` each, without the NaN that pads them."""
    for name, array in _arrays(path):
        values = _numbers(path, name, array)
        if values.ndim == 2:
            values = values[None]
        if values.ndim != 3 or values.shape[1] != 4:
            raise DataError(
                f"{path}, array '{name}': has the shape {array.shape}; events are arrays"
                " (events, 4, samples), or (4, samples)"
            )
        for event in values:
            recorded = np.flatnonzero(np.isfinite(event).any(axis=0))
            if len(recorded):
                yield event[:, : recorded[-1] + 1]


def _arrays(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yields the arrays of a file by their names; runs no code that may be in it."""
    start = first_bytes(path)
    try:
        if start == _NPY:
            yield path.name, np.load(path, allow_pickle=False)
        elif start == _ZIP:
            with np.load(path, allow_pickle=False) as arrays:
                for name in arrays.files:
                    array = arrays[name]
                    if not isinstance(array, np.ndarray):
                        raise DataError(
                            f"{path}: is a zip archive of other files ({name}), not of NumPy"
                            " arrays (.npz); unpack it"
                        )
                    yield name, array
        elif start == _MATLAB:
            yield from _matlab(path)
        elif start == _HDF:
            raise DataError(
                f"{path}: is a MATLAB file of version 7.3; save it with -v7, or as .npz"
            )
        else:
            raise DataError(f"{path}: is none of .npy, .npz and .mat")
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise DataError(f"{path}: {_UNPICKLE}") from None
        raise DataError(f"{path}: is cut off or damaged ({error}); download it again") from None
    except (OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise DataError(f"{path}: is cut off or damaged ({error}); download it again") from None


def _matlab(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yields the arrays of a MATLAB file; cells one by one."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        arrays = loadmat(path)
    except (MatReadError, NotImplementedError, TypeError) as error:
        raise DataError(f"{path}: cannot be read as a MATLAB file ({error})") from None
    for name, array in arrays.items():
        if name.startswith("__"):
            continue
        if array.dtype == object:
            for number, cell in enumerate(array.ravel(), start=1):
                yield f"{name}{{{number}}}", np.asarray(cell)
        else:
            yield name, array


def _numbers(path: Path, name: str, array: NDArray[Any]) -> Floats:
    if array.dtype.kind not in "fiu":
        raise DataError(f"{path}, array '{name}': holds {array.dtype}, not numbers")
    return array.astype(np.float64)
