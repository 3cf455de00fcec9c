"""Leader-follower pairs from a file or a data frame, read by the datasets of the command line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from cfx.app.overrides import config_of
from cfx.core import registry
from cfx.core.component import validate
from cfx.core.files import IN_MEMORY, absolute
from cfx.core.storage import path_or_url
from cfx.data.base import Dataset
from cfx.data.describe import dataset_of
from cfx.data.frames import Frame, frame_of_source
from cfx.data.names import named_twice, names_of
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, TidySettings, frame_of, pairs_from_frame, write_tidy
from cfx.errors import ConfigError, DataError, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PairsLike = Any
"""What `cfx.read` takes: `Pairs`, a `PairSet`, a data frame, or the path of a recording."""


PairIds = str | float | Iterable[str | float]
"""Ids of pairs, or one; 10, 10.0, "10" and " 10" are the same."""


def chosen_names(pair_ids: PairIds, available: Sequence[str], source: str) -> list[str]:
    """Returns the names of pairs that a caller chooses.

    Args:
        pair_ids: what they choose.
        available: names of all pairs.
        source: what messages call these.

    Raises:
        DataError: there is no pair of such a name, or one is named twice.
    """
    names = names_of(pair_ids)
    for name in names:
        if name not in available:
            raise DataError(f"{source}: there is no pair '{name}'.{nearest(name, available)}")
    twice = named_twice(names)
    if twice is not None:
        raise DataError(f"{source}: pair '{twice}' is named twice; name each pair once")
    return names


class FrameDataset(TidyDataset):
    """Pairs of a data frame in the tidy layout.

    Args:
        settings: as for a file; `path` is not read.
        frame: a row per pair and frame.
    """

    def __init__(self, settings: TidySettings, frame: Frame) -> None:
        super().__init__(settings)
        self._frame = frame

    def read(self) -> PairSet:
        layout, signals = self.settings.own_layout(), self.settings.further_signals()
        return pairs_from_frame(self._frame, "the table", layout, signals)


@dataclass(frozen=True, repr=False)
class Pairs:
    """Leader-follower pairs, and the settings of the dataset that read them.

    Attributes:
        selected: the pairs themselves.
        node: the dataset's node of the configuration: its name and settings.
    """

    selected: PairSet
    node: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, node: Mapping[str, Any]) -> Pairs:
        """Reads what a dataset's node says."""
        return cls(cast(Dataset, registry.create("dataset", node)).load(), node)

    @cached_property
    def frame(self) -> pd.DataFrame:
        """A row per pair and frame, in the tidy layout, SI units."""
        return frame_of(self.selected)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row per pair: pair_id, driver, frames, duration_s, mean_speed (m/s), mean_gap (m)."""
        rows = []
        for pair in self.selected:
            rows.append(
                {
                    "pair_id": pair.pair_id,
                    "driver": pair.driver,
                    "frames": len(pair),
                    "duration_s": pair.duration,
                    "mean_speed": float(np.mean(pair.follower_speed)),
                    "mean_gap": float(np.mean(pair.gap)),
                }
            )
        return pd.DataFrame(rows).set_index("pair_id")

    @property
    def dropped(self) -> pd.DataFrame:
        """What was left out: a row per reason, with its count and what was counted."""
        rows = [(drop.reason, drop.count, drop.unit) for drop in self.selected.dropped]
        return pd.DataFrame(rows, columns=["reason", "count", "unit"])

    def select(self, pair_ids: PairIds) -> Pairs:
        """Returns some of the pairs.

        Args:
            pair_ids: their ids, or one, as text or as numbers.

        Raises:
            DataError: there is no pair of such an id, or one is named twice.
        """
        available = self.selected.ids
        chosen_ids = chosen_names(pair_ids, available, self.selected.source)
        keep = [name in chosen_ids for name in available]
        chosen = self.selected.select(keep, "not selected")
        node = {**self.node, "pair_ids": chosen.ids}
        return replace(self, selected=chosen, node=node)

    def save(self, path: str | Path) -> Pairs:
        """Writes the pairs in the tidy layout; returns them as they are read from there.

        Args:
            path: ends in .parquet, .csv or .csv.gz.

        Raises:
            OutputError: the file cannot be written.
        """
        write_tidy(self.selected, path)
        settings = {
            "data": "tidy",
            "data.path": absolute(path),
            "data.min_duration": 0,
            "data.accelerations": "recorded",
            # Checked as they were recorded: averages in place of noisy accelerations lag behind
            # speeds and would be refused.
            "data.check": "off",
            "data.inputs": self.node.get("inputs", []),
        }
        return Pairs.of(config_of(settings).data)

    def plot(self, pair_ids: PairIds | None = None) -> Figure:
        """Draws speeds and gap of some pairs over time; returns the figure.

        Args:
            pair_ids: which; None: the first three.
        """
        from cfx.api.figures import draw_pairs
        from cfx.figures.drawing import for_notebooks

        chosen = self.selected[:3] if pair_ids is None else self.select(pair_ids).selected
        return for_notebooks(draw_pairs(list(chosen)))

    def __len__(self) -> int:
        return len(self.selected)

    def __repr__(self) -> str:
        drivers = self.summary["driver"].nunique()
        seconds = self.summary["duration_s"].sum()
        return (
            f"Pairs({len(self)} pairs of {drivers} drivers, {seconds:.0f} s in steps of"
            f" {self.selected.dt:g} s, from {self.selected.source}{self._left_out})"
        )

    @property
    def _left_out(self) -> str:
        """Says which pairs reading has left out."""
        reasons = []
        for drop in self.selected.dropped:
            if drop.unit == "pairs":
                reasons.append(f"{drop.count} {drop.reason}")
        return f"; left out: {', '.join(reasons)}" if reasons else ""

    def _repr_html_(self) -> str:
        from cfx.figures.drawing import as_html

        return as_html(repr(self), self.summary)


def read(source: Any = None, *, dataset: str | None = None, **settings: Any) -> Pairs:
    """Reads leader-follower pairs, as `data=DATASET data.path=SOURCE` on the command line.

    Args:
        source: the path or URL of a recording, a pattern, a list of them; or a table in the tidy
            layout: a data frame of any library (pandas, polars, pyarrow, xarray, DuckDB, Dask), a
            mapping of columns, a list of rows or of tables. None for a dataset that reads no file.
        dataset: the dataset that reads it, as after `data=`; None: found from the file itself.
        settings: of the dataset: `min_duration=30`, `time_step=0.1`, `max_pairs=20` and so on; a
            table's own names and units: `columns={"speed": "v"}`, `units={"speed": "km/h"}`.

    Raises:
        DataError: the recording cannot be read, with file, row and column.
        ConfigError: a setting is wrong.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=3, frames=200)
        >>> len(pairs), pairs.frame.shape[0]
        (3, 600)
        >>> cfx.read(pairs.frame, min_duration=0)
        Pairs(3 pairs of 3 drivers, 60 s in steps of 0.1 s, from the table)
    """
    if isinstance(source, Pairs):
        raise ConfigError("these pairs have been read already; give a file or a data frame")
    overrides = {f"data.{key}": value for key, value in settings.items()}
    if source is None:
        if dataset is None:
            raise ConfigError("give a file or a data frame, or dataset=NAME")
        return Pairs.of(config_of({"data": dataset, **overrides}).data)
    source = _all_of(source)
    frame = frame_of_source(source)
    if frame is not None:
        overrides["data.path"] = IN_MEMORY
        node = config_of({"data": dataset or "tidy", **overrides}).data
        values = dict(node)
        del values["name"]
        reader_settings = validate(TidySettings, values, where="data")
        return Pairs(FrameDataset(reader_settings, frame).load(), node)
    written = [source] if isinstance(source, str | Path) else _paths(source)
    paths = [path_or_url(path) for path in written]
    own_columns = {"columns", "units"} & settings.keys()
    layout = dataset or ("tidy" if own_columns else dataset_of(paths[0]))
    # A later change of the working directory then changes nothing.
    names = [path if isinstance(path, str) else str(path.absolute()) for path in paths]
    overrides["data.path"] = names[0] if len(names) == 1 else names
    return Pairs.of(config_of({"data": layout, **overrides}).data)


def _all_of(source: Any) -> Any:
    """Returns a list in place of a generator, whose elements can be had only once."""
    if isinstance(source, Iterator) and not hasattr(source, "read"):
        return list(source)
    return source


def _paths(source: Any) -> list[str | Path]:
    """Returns the paths of several recordings.

    Raises:
        ConfigError: it is no list of paths.
    """
    paths = list(source) if isinstance(source, list | tuple | set) else []
    if not paths or not all(isinstance(path, str | Path) for path in paths):
        raise ConfigError(
            f"what is given ({type(source).__name__}) is no recording; give a path, a list of"
            " paths, a data frame, or what cfx.read returned"
        )
    return paths


def pairs_from(source: PairsLike, settings: Mapping[str, Any] | None = None) -> Pairs:
    """Returns pairs of whatever `cfx.read` takes.

    Args:
        source: a file or a table is read, pairs that have been read are returned.
        settings: of a call; those of `data` say how a file or a table is read.

    Raises:
        ConfigError: the pairs have been read already, so that a setting of `data` does nothing.
    """
    of_data = {key: value for key, value in (settings or {}).items() if _is_of_data(key)}
    if isinstance(source, Pairs | PairSet):
        if of_data:
            key, value = next(iter(of_data.items()))
            raise ConfigError(
                f"{key}={value}: these pairs have been read already, so it does nothing; say it"
                f" where they are read: cfx.read(..., {key.partition('.')[2] or 'dataset'}=...)"
            )
        if isinstance(source, PairSet):
            return Pairs(source, {"name": "tidy", "path": IN_MEMORY})
        return source
    dataset = of_data.pop("data", None)
    reading = {key.partition(".")[2]: value for key, value in of_data.items()}
    return read(source, dataset=dataset, **reading)


def without_data(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings of a call that are not of `data`, which `pairs_from` reads."""
    return {key: value for key, value in settings.items() if not _is_of_data(key)}


def _is_of_data(key: str) -> bool:
    return key.partition(".")[0] == "data"
