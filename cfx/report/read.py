"""Reads a finished job from its folder alone.

No component is made, so a job of a plugin can be read where the plugin is not installed.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from cfx.core.errors import DataError
from cfx.core.job_folder import examine
from cfx.report.files import (
    optional,
    public,
    read_json,
    read_metrics,
    read_yaml,
    read_yaml_list,
    without_password,
)
from cfx.report.job import Job, Origin
from cfx.results.table import file_of, installed, read_tables


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
    tables = read_tables(folder)
    pairs = folder / "pairs.csv"
    if "pairs" not in tables:
        raise DataError(f"{pairs} is missing; run the job again, or leave it out")
    if not {"policy", "fixed"} & set(tables["pairs"]["method"]):
        raise DataError(f"{pairs} is damaged: it has no row of the method 'policy' or 'fixed'")
    missing = [one for one in installed() if one.part.always and one.name not in tables]
    hydra = folder if origin.hydra is None else origin.hydra
    started, seconds = _duration(hydra, origin)
    return Job(
        place=origin.place,
        config=public(config),
        data=public(data),
        metrics=read_metrics(folder / "metrics.json"),
        tables=tables,
        overrides=_overrides(hydra),
        experiment=str(config.get("preset") or ""),
        started=started,
        seconds=seconds,
        version=_version(data, origin),
        missing=tuple(file_of(one) for one in missing),
    )


def _version(data: Mapping[str, Any], origin: Origin) -> str:
    """Returns cfx's version and the commit of the folder that the job was started in."""
    version = str(origin.version or data.get("cfx", "") or "")
    commit = str(data.get("commit", "") or "")
    if not commit:
        return version
    return f"{version}, commit {commit}".removeprefix(", ")


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
