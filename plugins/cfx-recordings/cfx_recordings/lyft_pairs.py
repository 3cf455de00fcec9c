"""Car-following pairs of Lyft's Level 5 dataset, as its extractors published them.

G. Li, Y. Jiao, V. L. Knoop, S. C. Calvert and J. W. C. van Lint (2023), Large car-following data
based on Lyft level-5 open dataset: following autonomous vehicles vs. human-driven vehicles, IEEE
ITSC; github.com/RomainLITUD/Car-Following-Dataset-HV-vs-AV.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cfx.errors import DataError
from cfx.plugin import (
    Contents,
    Dataset,
    FileDatasetSettings,
    FileStart,
    Floats,
    Ints,
    PairSet,
    Settings,
    joined,
    stem,
)
from cfx_recordings.series import Series, frames_at, pairs_of

DT = 0.1
"""Seconds between two samples."""

_SIGNALS = {
    "leader_position": "lead_centroid",
    "leader_speed": "lead_velocity",
    "leader_acceleration": "lead_acceleration",
    "follower_position": "follow_centroid",
    "follower_speed": "follow_velocity",
    "follower_acceleration": "follow_acceleration",
}
"""A pair's signals, and the arrays that they are in."""

_NEEDED = ("index_range", "timestamp", *_SIGNALS.values())
_SIZES = {"leader": "lead_size", "follower": "follow_size"}

_COMPRESSORS = ("blosc", "zlib", "gzip", "zstd", "lz4", "bz2", "lzma")
"""Compressors that only unpack bytes; among what Zarr takes for one there is a pickle too."""

_TYPES = {"H": "human", "A": "automated"}
"""Letters at the end of a store's name: first the follower, then the leader."""


class LyftPairsSettings(FileDatasetSettings):
    """How to read the Lyft pairs."""

    automated_length: float = Field(
        4.85, gt=0, le=100, description="m: of Lyft's own vehicles, whose size the stores leave out"
    )


class LyftPairsDataset(Dataset):
    """Pairs of a Zarr store such as `trainHH.zarr`: `data.path` is the folder.

    Pair n has the samples `index_range[n]` of the arrays `timestamp`, `lead_centroid`,
    `lead_velocity`, `lead_acceleration` and those of the follower. Centroids are the middles of
    vehicles along the path; the front bumper is half of `lead_size[n]` or `follow_size[n]` farther.
    Where samples are missing within a pair it is cut.

    **Labels.** Two letters end the store's name: HH is a human behind a human, HA a human behind
    Lyft's automated vehicle, AH the automated vehicle behind a human.

    **Drivers.** Pairs carry no vehicles' ids; each counts as a driver of its own.

    Stores whose arrays hold Python objects or are filtered by anything are refused before they are
    opened: reading them could run code.
    """

    layout = "Lyft car-following pairs (Li et al. 2023)"
    schema: ClassVar[type[Settings]] = LyftPairsSettings
    settings: LyftPairsSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        return (start.path / "index_range" / ".zarray").is_file()

    def read(self) -> PairSet:
        return self.contents().pairs

    def contents(self) -> Contents:
        stores = [_read(path, self.settings.automated_length) for path in self.settings.files()]
        pairs = joined([_pairs(store) for store in stores])
        rows = sum(len(store.time) for store in stores)
        problem = "pairs carry no drivers' ids: one driver may be learned from and tested"
        return Contents(pairs, rows, 0, problem, unnamed="leaders and followers have no ids")


class _Store(NamedTuple):
    """A store's arrays: `ranges` `(P, 2)`, sizes `(P,)`, the others `(N,)`."""

    path: Path
    ranges: Ints
    time: Floats
    signals: dict[str, Floats]
    sizes: dict[str, Floats]


def _read(path: Path, automated_length: float) -> _Store:
    import zarr

    if not path.is_dir():
        raise DataError(f"{path}: is no folder; a Zarr store such as trainHH.zarr is one")
    for name in _NEEDED:
        _require_plain(path, name)
    sized = [name for name in _SIZES.values() if (path / name).exists()]
    for name in sized:
        _require_plain(path, name)
    try:
        group: Any = zarr.open_group(str(path), mode="r")
        arrays = {name: np.asarray(group[name][:]) for name in (*_NEEDED, *sized)}
    except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
        raise DataError(f"{path}: is cut off or damaged ({error}); download it again") from None
    ranges = arrays["index_range"].astype(np.int64)
    signals = {}
    for signal, name in _SIGNALS.items():
        signals[signal] = arrays[name].astype(np.float64)
    sizes = {}
    for who, name in _SIZES.items():
        default = np.full(len(ranges), automated_length)
        sizes[who] = arrays.get(name, default).astype(np.float64)
    store = _Store(path, ranges, arrays["timestamp"].astype(np.float64), signals, sizes)
    _check(store)
    return store


def _require_plain(path: Path, name: str) -> None:
    """Raises DataError unless an array is there, holds plain numbers, and has no filters."""
    about = path / name / ".zarray"
    if not about.is_file():
        raise DataError(f"{path}: has no array '{name}' (no {name}/.zarray)")
    try:
        described = json.loads(about.read_text())
        kind = np.dtype(described["dtype"]).kind
        filters = described.get("filters")
        compressor = (described.get("compressor") or {"id": "zlib"})["id"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{about}: is no description of an array ({error})") from None
    if kind not in "fiu" or filters or compressor not in _COMPRESSORS:
        raise DataError(
            f"{about}: holds {described['dtype']}, filtered by {filters} and compressed by"
            f" {compressor}; only plain numbers without filters are read, as others could run code"
        )


def _check(store: _Store) -> None:
    """Raises DataError where the arrays do not belong together."""
    size = len(store.time)
    for name, values in store.signals.items():
        if values.shape != (size,):
            raise DataError(
                f"{store.path}: {_SIGNALS[name]} has the shape {values.shape}, timestamp ({size},)"
            )
    ranges = store.ranges
    if ranges.ndim != 2 or ranges.shape[1] != 2:
        raise DataError(f"{store.path}: index_range has the shape {ranges.shape}, not (pairs, 2)")
    bad = (ranges[:, 0] < 0) | (ranges[:, 1] > size) | (ranges[:, 0] >= ranges[:, 1])
    if bool(bad.any()):
        raise DataError(
            f"{store.path}: index_range {np.flatnonzero(bad)[0]} is"
            f" {ranges[np.flatnonzero(bad)[0]].tolist()}, outside of the {size} samples"
        )
    for who, sizes in store.sizes.items():
        if len(sizes) != len(ranges):
            raise DataError(
                f"{store.path}: {_SIZES[who]} has {len(sizes)} values for {len(ranges)} pairs"
            )


def _pairs(store: _Store) -> PairSet:
    recording = stem(store.path)
    letters = re.search(r"([HA])([HA])$", recording)
    types = ("", "")
    if letters:
        types = (_TYPES[letters[1]], _TYPES[letters[2]])
    series = []
    for number, (start, stop) in enumerate(store.ranges.tolist()):
        run = slice(start, stop)
        signals = {name: values[run] for name, values in store.signals.items()}
        for who, sizes in store.sizes.items():
            signals[f"{who}_position"] = signals[f"{who}_position"] + sizes[number] / 2
        pair = Series(
            name=f"{recording}-{number}",
            recording=recording,
            leader_id=f"leader-{number}",
            follower_id=str(number),
            dt=DT,
            frame=frames_at(store.time[run], DT, f"{store.path}, pair {number}"),
            signals=signals,
            leader_length=float(store.sizes["leader"][number]),
            driver_types=(types[0],),
            leader_driver_type=types[1],
        )
        series.append(pair)
    return pairs_of(series, str(store.path))
