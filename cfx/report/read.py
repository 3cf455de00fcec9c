"""Reads a finished job from its folder alone.

No component is made, so a job of a plugin can be read where the plugin is not installed.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from cfx.core.job_folder import examine
from cfx.evaluation.distributions import DISTRIBUTION_COLUMNS
from cfx.evaluation.forecasts import FORECAST_COLUMNS
from cfx.evaluation.traffic.result import GROWTH_COLUMNS, ROAD_COLUMNS, STRIP_COLUMNS
from cfx.report.files import (
    optional,
    public,
    read_json,
    read_metrics,
    read_pairs,
    read_table,
    read_yaml,
    read_yaml_list,
    without_password,
)
from cfx.report.job import Job, Origin

_COLUMNS = {
    "pairs.csv": (
        "pair_id",
        "driver",
        "cluster",
        "method",
        "rmse_speed",
        "rmse_gap",
        "improvement",
        "collisions",
        "frames",
    ),
    "style.csv": ("driver", "score", "cluster"),
    "trajectories.parquet": ("pair_id", "time_s", "leader_speed", "real_speed", "real_gap"),
    "curves.parquet": ("network", "epoch", "train_loss", "validation_loss"),
    "platoon.parquet": ("method", "network", "vehicle", "time_s", "speed", "gap"),
    "history.parquet": (
        "pair_id",
        "driver",
        "base",
        "history_s",
        "amount",
        "rmse_speed",
        "rmse_gap",
        "improvement",
    ),
    "slices.parquet": ("pair_id", "parameter", "place", "value", "loss", "best_loss"),
    "fits.parquet": ("pair_id", "method", "train_rmse_speed", "test_rmse_speed"),
    "labels.parquet": ("pair_id", "time_s", "loss", "sensitivity"),
    "pair_metrics.parquet": ("pair_id", "method", "scope", "metric", "value"),
    "forecasts.parquet": FORECAST_COLUMNS,
    "distributions.parquet": DISTRIBUTION_COLUMNS,
    "traffic.parquet": ROAD_COLUMNS,
    "traffic_growth.parquet": GROWTH_COLUMNS,
    "traffic_strips.parquet": STRIP_COLUMNS,
}
"""Columns that the files of a job have at the least."""

_EXPECTED = ("style.csv", "trajectories.parquet", "curves.parquet")
"""Files that every job leaves, whatever its protocol."""


def read_job(folder: Path, origin: Origin) -> Job:
    """Reads one finished job.

    Args:
        folder: with `metrics.json`, `pairs.csv` and the other files of a job.
        origin: what is known besides.

    Raises:
        DataError: a file cannot be read, or is not what a job writes.
    """
    examine(folder)
    config = read_yaml(folder / "config.yaml")
    data = optional(folder / "data.json", read_json) or {}
    tables = {name: _table(folder, name) for name in _COLUMNS if name != "pairs.csv"}
    hydra = folder if origin.hydra is None else origin.hydra
    started, seconds = _duration(hydra, origin)
    return Job(
        place=origin.place,
        config=public(config),
        data=public(data),
        metrics=read_metrics(folder / "metrics.json"),
        pairs=read_pairs(folder / "pairs.csv", _COLUMNS["pairs.csv"]),
        style=tables["style.csv"],
        trajectories=tables["trajectories.parquet"],
        curves=tables["curves.parquet"],
        platoon=tables["platoon.parquet"],
        history=tables["history.parquet"],
        slices=tables["slices.parquet"],
        fits=tables["fits.parquet"],
        labels=tables["labels.parquet"],
        values=tables["pair_metrics.parquet"],
        forecasts=tables["forecasts.parquet"],
        distributions=tables["distributions.parquet"],
        traffic=tables["traffic.parquet"],
        traffic_growth=tables["traffic_growth.parquet"],
        traffic_strips=tables["traffic_strips.parquet"],
        overrides=_overrides(hydra),
        experiment=str(config.get("preset") or ""),
        started=started,
        seconds=seconds,
        version=_version(data, origin),
        missing=tuple(name for name in _EXPECTED if tables[name] is None),
    )


def _version(data: Mapping[str, Any], origin: Origin) -> str:
    """Returns cfx's version and the commit of the folder that the job was started in."""
    version = str(origin.version or data.get("cfx", "") or "")
    commit = str(data.get("commit", "") or "")
    if not commit:
        return version
    return f"{version}, commit {commit}".removeprefix(", ")


def _table(folder: Path, name: str) -> pd.DataFrame | None:
    return optional(folder / name, partial(read_table, columns=_COLUMNS[name]))


def _overrides(folder: Path) -> tuple[str, ...] | None:
    typed = optional(folder / ".hydra" / "overrides.yaml", read_yaml_list)
    if typed is None:
        return None
    return tuple(without_password(str(one)) for one in typed)


def _duration(folder: Path, origin: Origin) -> tuple[datetime | None, float | None]:
    """Returns when the job began, and how many seconds it took."""
    if origin.started is not None:
        return origin.started, origin.seconds
    started, seconds = _times(folder / "cfx.log")
    status = optional(folder / "outcome.json", read_json) or {}
    if isinstance(status.get("seconds"), int | float):
        seconds = float(status["seconds"])
    return started, seconds


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
    if not stamps:
        return None, None
    return stamps[0], (stamps[-1] - stamps[0]).total_seconds()
