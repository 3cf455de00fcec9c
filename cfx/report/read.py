"""Finished jobs, read from their folders alone: no component is made, so a plugin's job can be read where it is not installed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from cfx import renamed
from cfx.errors import DataError
from cfx.evaluation.result import METHODS
from cfx.style.result import CLUSTERS

T = TypeVar("T")

_PAIR_COLUMNS = (
    "pair_id",
    "driver",
    "cluster",
    "method",
    "rmse_speed",
    "rmse_gap",
    "improvement",
    "collisions",
    "frames",
)
_STYLE_COLUMNS = ("driver", "score", "cluster")
_DRIVE_COLUMNS = ("pair_id", "time_s", "leader_speed", "real_speed", "real_gap")
_PLATOON_COLUMNS = ("method", "network", "vehicle", "time_s", "speed", "gap")
_HISTORY_COLUMNS = (
    "pair_id",
    "driver",
    "base",
    "history_s",
    "amount",
    "rmse_speed",
    "rmse_gap",
    "improvement",
)
_CURVE_COLUMNS = ("network", "epoch", "train_loss", "validation_loss")
_PASSWORD = re.compile(r"(://[^/@\s:]*):[^/@\s]+@")


@dataclass(frozen=True)
class Job:
    """One finished job.

    Attributes:
        place: where it was read: its folder, or its MLflow run.
        config: the resolved configuration.
        data: where the pairs came from and what was left out (`data.json`).
        metrics: under their MLflow names; NaN where a metric is not defined.
        pairs: a row per pair and method; SI units; `cluster` by name.
        style: a row per driver; None if the job left none.
        drives: the closed loops of the test part, a row per frame; SI units; None if the job left none.
        curves: the losses by network and epoch; None if the job left none.
        platoon: `Evaluation.platoon`'s table; None if no platoon was driven.
        history: as `Evaluation.history`; None if that was not tried.
        overrides: what was typed; None if that is not known.
        experiment: the preset that was chosen, "" for none; None if that is not known.
        started: when it began; None if that is not known.
        seconds: how long it took; None if that is not known.
        version: of cfx; "" if that is not known.
        missing: files that jobs have and this one has not.
        name: what tells it from the others of one report.
    """

    place: str
    config: Mapping[str, Any]
    data: Mapping[str, Any]
    metrics: Mapping[str, float]
    pairs: pd.DataFrame
    style: pd.DataFrame | None
    drives: pd.DataFrame | None
    curves: pd.DataFrame | None
    platoon: pd.DataFrame | None = None
    history: pd.DataFrame | None = None
    overrides: tuple[str, ...] | None = None
    experiment: str | None = None
    started: datetime | None = None
    seconds: float | None = None
    version: str = ""
    missing: tuple[str, ...] = ()
    name: str = ""

    def component(self, group: str) -> str:
        """Returns the name of a component: of the group "model" for instance "w99".

        It is "" for the learner of a job that trains nothing, whatever its configuration says.
        """
        if group == "learner" and self.component("protocol") == "transfer":
            return ""
        node = self.config.get(group)
        return str(node.get("name", "")) if isinstance(node, Mapping) else ""

    def setting(self, path: str) -> Any:
        """Returns a setting such as "style.cluster"; None if the configuration has none of that name."""
        value: Any = self.config
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, in the order in which they are shown."""
        present = [str(method) for method in self.pairs["method"].unique()]
        return tuple(
            sorted(
                present,
                key=lambda method: METHODS.index(method) if method in METHODS else len(METHODS),
            )
        )

    @property
    def has_constant_baseline(self) -> bool:
        """Says whether the model follows its leader with constant parameters, so that those are baselines."""
        return renamed.data(self.data).get("has_constant_baseline") is not False

    def baselines(self, where: str = "") -> tuple[str, ...]:
        """Returns what the policy was compared with, the driver's own fixed parameters first; nothing if `has_constant_baseline` is false.

        Args:
            where: "" for the test part, "later/" for what of it is beyond the first 5 s, "whole/" for whole drives.
        """
        if not self.has_constant_baseline:
            return ()
        found = ("fixed", *(method for method in self.methods if method not in {"fixed", "policy"}))
        known = {
            baseline
            for baseline in found
            if f"{improvement_of(baseline, where)}/mean" in self.metrics
        }
        return tuple(baseline for baseline in found if baseline in known & set(self.methods))

    @property
    def split(self) -> float:
        """Share of each pair that was calibrated on; NaN if that is not known."""
        split = self.config.get("split")
        return float(split) if isinstance(split, int | float) else math.nan

    @cached_property
    def by_pair(self) -> pd.DataFrame:
        """A row per pair.

        Columns: pair_id, driver, cluster, style_score, `rmse_speed/METHOD`, `rmse_gap/METHOD`, `improvement/BASELINE`.
        """
        first = self.pairs.drop_duplicates("pair_id").set_index("pair_id")
        table = first[
            [name for name in ("driver", "cluster", "style_score") if name in first]
        ].copy()
        for method, rows in self.pairs.groupby("method"):
            of_method = rows.drop_duplicates("pair_id").set_index("pair_id")
            for column in ("rmse_speed", "rmse_gap"):
                table[f"{column}/{method}"] = of_method[column]
            if method == "policy":
                for baseline in self.methods:
                    if improvement_column(baseline) in of_method:
                        table[f"improvement/{baseline}"] = of_method[improvement_column(baseline)]
        return table.reset_index()


@dataclass(frozen=True)
class Unfinished:
    """A job that cannot be reported: where it is, and why."""

    place: str
    reason: str


@dataclass(frozen=True)
class Runs:
    """What was found: finished jobs, each with a name of its own, and the others."""

    jobs: tuple[Job, ...]
    unfinished: tuple[Unfinished, ...] = ()


@dataclass(frozen=True)
class Origin:
    """What is known of a job besides its files: of a tracked one, from MLflow."""

    place: str
    started: datetime | None = None
    seconds: float | None = None
    version: str = ""
    hydra: Path | None = field(default=None)


def improvement_of(baseline: str, where: str = "") -> str:
    """Returns how the metrics of the improvement over a baseline begin."""
    return f"{where}rmse_improvement" + (
        "" if baseline == "fixed" and not where else f"/{baseline}"
    )


def improvement_column(baseline: str) -> str:
    """Returns the column of `pairs.csv` with the improvement over a baseline."""
    return "improvement" if baseline == "fixed" else f"improvement_over_{baseline}"


def read_job(folder: Path, origin: Origin) -> Job:
    """Reads one finished job.

    Args:
        folder: with `metrics.json`, `pairs.csv` and the other files of a job.
        origin: what is known besides.

    Raises:
        DataError: a file cannot be read, or is not what a job writes.
    """
    config, data = _yaml(folder / "config.yaml"), _optional(folder / "data.json", read_json) or {}
    optional = {
        "style.csv": _optional(folder / "style.csv", lambda path: _table(path, _STYLE_COLUMNS)),
        "trajectories.parquet": _optional(
            renamed.file(folder / "trajectories.parquet"),
            lambda path: _table(path, _DRIVE_COLUMNS),
        ),
        "curves.parquet": _optional(
            folder / "curves.parquet", lambda path: _table(path, _CURVE_COLUMNS)
        ),
    }
    hydra = origin.hydra if origin.hydra is not None else folder
    started, seconds = _times(hydra / "cfx.log")
    status = _optional(hydra / "outcome.json", read_json) or {}
    if isinstance(status.get("seconds"), int | float):
        seconds = float(status["seconds"])
    if origin.started is not None:
        started, seconds = origin.started, origin.seconds
    overrides = _optional(hydra / ".hydra" / "overrides.yaml", _yaml_list)
    return Job(
        place=origin.place,
        config=_public(config),
        data=_public(data),
        metrics=_metrics(folder / "metrics.json"),
        pairs=_pairs(folder / "pairs.csv"),
        style=optional["style.csv"],
        drives=optional["trajectories.parquet"],
        curves=optional["curves.parquet"],
        platoon=_optional(folder / "platoon.parquet", lambda path: _table(path, _PLATOON_COLUMNS)),
        history=_optional(folder / "history.parquet", lambda path: _table(path, _HISTORY_COLUMNS)),
        overrides=None
        if overrides is None
        else tuple(without_password(str(one)) for one in overrides),
        experiment=_experiment(config, hydra),
        started=started,
        seconds=seconds,
        version=str(origin.version or data.get("cfx", "") or ""),
        missing=tuple(name for name, content in optional.items() if content is None),
    )


def _experiment(config: Mapping[str, Any], folder: Path) -> str | None:
    """Returns the preset that was chosen: what the job wrote down itself, else what Hydra did."""
    if "preset" in config:
        return str(config["preset"] or "")
    values: Any = _optional(folder / ".hydra" / "hydra.yaml", _yaml)
    for key in ("hydra", "runtime", "choices"):
        values = values.get(key) if isinstance(values, Mapping) else None
    return str(values.get("experiment") or "") if isinstance(values, Mapping) else None


def _times(log: Path) -> tuple[datetime | None, float | None]:
    """Returns when a log begins and how long it is; each line begins with its time."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None, None
    stamps = []
    for line in lines:
        try:
            stamps.append(datetime.strptime(line[:19], "%Y-%m-%d %H:%M:%S"))
        except ValueError:
            continue
    return (stamps[0], (stamps[-1] - stamps[0]).total_seconds()) if stamps else (None, None)


def _metrics(path: Path) -> dict[str, float]:
    try:
        values = {
            str(name): math.nan if value is None else float(value)
            for name, value in read_json(path).items()
        }
        return renamed.metrics(values)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path} is damaged: a metric is no number ({error})") from error


def _pairs(path: Path) -> pd.DataFrame:
    table = _table(path, _PAIR_COLUMNS)
    names = {str(number): name for number, name in enumerate(CLUSTERS)}
    table["cluster"] = [names.get(str(value), str(value)) for value in table["cluster"]]
    if "policy" not in set(table["method"]):
        raise DataError(f"{path} is damaged: it has no row of the method 'policy'")
    return table


_TEXT = dict.fromkeys(
    (
        "pair_id",
        "recording",
        "leader_id",
        "follower_id",
        "driver",
        "method",
        "network",
        "base",
        "amount",
    ),
    str,
)


def _table(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    try:
        if path.suffix == ".parquet":
            table = pd.read_parquet(path)
        else:
            # An id such as "NA" is an id, and "007" is no number.
            table = pd.read_csv(
                path,
                dtype=_TEXT,
                keep_default_na=False,
                na_values={key: ["", "nan"] for key in _numbers(path)},
            )
    except (
        OSError,
        ValueError,
        ArithmeticError,
    ) as error:  # pyarrow's and pandas' errors are ValueErrors or OSErrors
        raise DataError(
            f"{path} cannot be read ({_first_line(error)}); run the job again, or leave it out"
        ) from error
    table = renamed.results(table)
    lacking = [column for column in columns if column not in table]
    if lacking:
        raise DataError(f"{path} is damaged: it has no column '{lacking[0]}'")
    numbers = [column for column in table if column not in {*_TEXT, "cluster", "cluster_name"}]
    for column in numbers:
        try:
            table[column] = table[column].astype(float)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"{path} is damaged: column '{column}' holds something else than numbers ({error})"
            ) from error
    for column in {*_TEXT} & set(table.columns):
        table[column] = table[column].astype(str).astype(object)
    return table


def _numbers(path: Path) -> list[str]:
    header = pd.read_csv(path, nrows=0)
    return [str(column) for column in header if column not in {*_TEXT, "cluster", "cluster_name"}]


def read_json(path: Path) -> dict[str, Any]:
    """Reads a mapping.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    return _mapping(path, json.loads)


def _yaml(path: Path) -> dict[str, Any]:
    return _mapping(path, yaml.safe_load)


def _yaml_list(path: Path) -> list[Any]:
    content = _read(path, yaml.safe_load)
    return list(content) if isinstance(content, list) else []


def _mapping(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    content = _read(path, parse)
    if not isinstance(content, dict):
        raise DataError(f"{path} is damaged: it holds no mapping of names to values")
    return content


def _read(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise DataError(
            f"{path} cannot be read ({_first_line(error)}); run the job again, or leave it out"
        ) from error


def _optional(path: Path, read: Callable[[Path], T]) -> T | None:
    return read(path) if path.exists() else None


def _first_line(error: Exception) -> str:
    return next(
        (line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__
    )


def _public(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values as they may be sent to a colleague: without the passwords of database addresses."""

    def clean(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: clean(part) for key, part in value.items()}
        if isinstance(value, list):
            return [clean(part) for part in value]
        return without_password(value) if isinstance(value, str) else value

    return {key: clean(value) for key, value in values.items()}


def without_password(text: str) -> str:
    """Returns a text in which the passwords of addresses such as `postgresql://name:password@host` are three stars."""
    return _PASSWORD.sub(r"\1:***@", text)


def finite(values: Iterable[float]) -> NDArray[np.float64]:
    """Returns the finite ones of some values."""
    array: NDArray[np.float64] = np.asarray(list(values), dtype=float)
    return array[np.isfinite(array)]
