"""Finds and reads the jobs that a user means: folders, sweeps, MLflow runs.

No component is made, so a job of a plugin can be read where the plugin is not installed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from cfx.core.errors import DataError, TrackingError
from cfx.core.job_folder import (
    examine,
    optional,
    public,
    read_json,
    read_metrics,
    read_yaml,
    read_yaml_list,
    without_password,
)
from cfx.core.storage import is_url, local_folder
from cfx.report.job import Job, Origin, Runs, Unfinished
from cfx.report.names import named
from cfx.results.store import (
    download_run,
    is_run_id,
    open_store,
    sqlite_file,
    tracking_uri,
    translate_errors,
)
from cfx.results.table import file_of, installed, read_tables

_MOST = 1000
"""Most jobs of one sweep that are asked for."""


def tracked_runs(run_id: str) -> list[tuple[Path, Origin] | Unfinished]:
    """Returns folder and origin of a tracked job; of a sweep's parent, those of each of its jobs.

    Raises:
        TrackingError: there is no such run, or its files are gone.
    """
    uri = tracking_uri(None)
    file = sqlite_file(uri)
    if not is_run_id(run_id) or (file is not None and not file.is_file()):
        return [
            (download_run(run_id), Origin(run_id))
        ]  # it says what is wrong with the id or the store
    store = open_store(uri, "cfx")
    with translate_errors(f"read run {run_id} from {uri}"):
        run = store.client.get_run(run_id)
        sweep = run.data.tags.get("cfx.sweep_parent")
        if sweep is None:
            return [_found(run)]
        jobs = store.client.search_runs(
            [run.info.experiment_id], f"tags.`cfx.sweep` = '{sweep}'", max_results=_MOST
        )
    if not jobs:
        raise TrackingError(f"run {run_id} is the parent of a sweep without any job")
    return [_found(job) for job in sorted(jobs, key=lambda job: job.info.start_time or 0)]


def _found(run: Any) -> tuple[Path, Origin] | Unfinished:
    tags, info = run.data.tags, run.info
    place = f"MLflow run {info.run_id}"
    if info.status != "FINISHED":
        return Unfinished(
            place, tags.get("cfx.failure") or f"not finished: MLflow says {info.status}"
        )
    seconds = (info.end_time - info.start_time) / 1000 if info.end_time else None
    # Where the job ran on this machine, its folder tells what was typed; MLflow does not keep that.
    there = Path(tags.get("cfx.folder", ""))
    return (
        download_run(info.run_id),
        Origin(
            place=place,
            started=datetime.fromtimestamp(info.start_time / 1000),
            seconds=seconds,
            version=tags.get("cfx.version", ""),
            hydra=there if tags.get("cfx.folder") and (there / "metrics.json").is_file() else None,
        ),
    )


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


_PASSED_OVER = {".hydra", "mlartifacts", "figures", "policy", "cache"}
"""Folders below an output folder that hold no jobs of their own."""

_MARKS = {"metrics.json", "config.yaml", "outcome.json"}
"""Files that show a job's folder."""


def read_runs(runs: Sequence[str]) -> Runs:
    """Reads jobs.

    Args:
        runs: each an output folder of a job, a folder with jobs below it, the URL of either
            (`output.url`), or the id of an MLflow run, also of a sweep's parent.

    Raises:
        DataError: a folder holds no finished job, or a job's file is damaged.
        TrackingError: there is no such run.
    """
    jobs: dict[str, Job] = {}
    given: dict[str, int] = {}
    unfinished: dict[str, Unfinished] = {}
    for number, run in enumerate(runs):
        for found in _read(run):
            if isinstance(found, Job):
                jobs.setdefault(found.place, found)
                given.setdefault(found.place, number)
            else:
                unfinished.setdefault(found.place, found)
    # Folders of a sweep are named by content: only the jobs' names have an order that people see.
    ordered = sorted(
        named(tuple(jobs.values())), key=lambda job: (given[job.place], natural_order(job.name))
    )
    return Runs(tuple(ordered), tuple(unfinished.values()))


def _read(run: str) -> list[Job | Unfinished]:
    """Returns the jobs that one word on the command line stands for."""
    if is_url(run):
        copy = local_folder(run)
        return _of_folder(
            copy, lambda job: f"{run.rstrip('/')}/{job.relative_to(copy)}".removesuffix("/.")
        )
    path = Path(run).expanduser()
    if path.exists():
        return _of_folder(path, lambda job: str(job.absolute()))
    return _of_mlflow(run)


def _of_folder(folder: Path, place: Callable[[Path], str]) -> list[Job | Unfinished]:
    """Returns the jobs below a folder.

    Args:
        folder: as it lies on this machine.
        place: takes the folder of a job, and returns what people know it by.
    """
    if not folder.is_dir():
        raise DataError(
            f"{folder} is a file; give a job's output folder, a sweep's folder, or the id of an"
            " MLflow run"
        )
    found = [_one(job, place(job)) for job in _job_folders(folder)]
    if not any(isinstance(one, Job) for one in found):
        raise DataError(
            f"{folder} holds no finished job (a finished one has a metrics.json){_reasons(found)}"
        )
    return found


def _of_mlflow(run: str) -> list[Job | Unfinished]:
    found: list[Job | Unfinished] = []
    for one in tracked_runs(run):
        found.append(one if isinstance(one, Unfinished) else read_job(*one))
    if not any(isinstance(one, Job) for one in found):
        raise DataError(f"run {run} holds no finished job{_reasons(found)}")
    return found


def _reasons(found: Sequence[Job | Unfinished]) -> str:
    text = ""
    for one in found:
        if isinstance(one, Unfinished):
            text += f"; {one.place}: {one.reason}"
    return text


def _job_folders(folder: Path) -> Iterator[Path]:
    """Yields the folders that a job was started in, `folder` or below it, by their names."""
    for place, below, files in os.walk(folder):
        if _MARKS & set(files) or ".hydra" in below:
            below.clear()
            yield Path(place)
        else:
            below[:] = sorted(set(below) - _PASSED_OVER, key=natural_order)


def _one(folder: Path, place: str) -> Job | Unfinished:
    if (folder / "metrics.json").is_file():
        return read_job(folder, Origin(place))
    status = optional(folder / "outcome.json", read_json) or {}
    if status.get("code"):
        return Unfinished(place, f"failed: {without_password(str(status.get('message', '')))}")
    return Unfinished(place, "not finished: it has no metrics.json")


def natural_order(name: str) -> list[tuple[int, str]]:
    """Returns a sorting key that puts "i80/9" before "i80/11"."""
    key = []
    for part in re.split(r"(\d+)", name):
        if part.isdigit():
            key.append((int(part), ""))
        elif part:
            key.append((-1, part))
    return key
