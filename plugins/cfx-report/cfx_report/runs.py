"""Finds and reads the jobs that a user means: folders, sweeps, MLflow runs.

No component is made, so a job of a plugin can be read where the plugin is not installed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from cfx.errors import DataError, without_passwords
from cfx.plugin import Origin, Result, job_folder, read_result, storage, tracking_of_run
from cfx_report.jobs import Runs, Unfinished
from cfx_report.names import named

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
    jobs: dict[str, Result] = {}
    order: dict[str, int] = {}  # as the runs are listed
    unfinished: dict[str, Unfinished] = {}
    for number, run in enumerate(runs):
        for result in _read(run):
            if isinstance(result, Result):
                jobs.setdefault(result.place, result)
                order.setdefault(result.place, number)
            else:
                unfinished.setdefault(result.place, result)
    # Folders of a sweep are named by content: only the jobs' names have an order that people see.
    ordered = sorted(
        named(tuple(jobs.values())), key=lambda job: (order[job.place], natural_order(job.name))
    )
    return Runs(tuple(ordered), tuple(unfinished.values()))


def _read(run: str) -> list[Result | Unfinished]:
    """Returns the jobs that one word on the command line stands for."""
    if storage.is_url(run):
        copy = storage.local_folder(run)
        return _of_folder(
            copy, lambda job: f"{run.rstrip('/')}/{job.relative_to(copy)}".removesuffix("/.")
        )
    path = Path(run).expanduser()
    if path.exists():
        return _of_folder(path, lambda job: str(job.absolute()))
    return _of_mlflow(run)


def _of_folder(folder: Path, place: Callable[[Path], str]) -> list[Result | Unfinished]:
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
    jobs = [_one(job, place(job)) for job in _job_folders(folder)]
    if not any(isinstance(result, Result) for result in jobs):
        raise DataError(
            f"{folder} holds no finished job (a finished one has a metrics.json){_reasons(jobs)}"
        )
    return jobs


def _of_mlflow(run: str) -> list[Result | Unfinished]:
    jobs: list[Result | Unfinished] = []
    for tracked in tracking_of_run(run).jobs_of_run(run):
        if tracked.folder is None:
            jobs.append(Unfinished(tracked.place, tracked.reason))
        else:
            jobs.append(_whole(tracked))
    if not any(isinstance(result, Result) for result in jobs):
        raise DataError(f"run {run} holds no finished job{_reasons(jobs)}")
    return jobs


def _reasons(jobs: Sequence[Result | Unfinished]) -> str:
    text = ""
    for job in jobs:
        if isinstance(job, Unfinished):
            text += f"; {job.place}: {job.reason}"
    return text


def _job_folders(folder: Path) -> Iterator[Path]:
    """Yields the folders that a job was started in, `folder` or below it, by their names."""
    for place, below, files in os.walk(folder):
        if _MARKS & set(files) or ".hydra" in below:
            below.clear()
            yield Path(place)
        else:
            below[:] = sorted(set(below) - _PASSED_OVER, key=natural_order)


def _whole(origin: Origin) -> Result:
    """Reads a job with all of its tables, so that a damaged one is named before a page is made."""
    job = read_result(origin)
    for name in job.tables:
        _ = job.tables[name]
    return job


def _one(folder: Path, place: str) -> Result | Unfinished:
    if (folder / "metrics.json").is_file():
        return _whole(Origin(place, folder))
    status = job_folder.optional(folder / "outcome.json", job_folder.read_json) or {}
    if status.get("code"):
        return Unfinished(place, f"failed: {without_passwords(str(status.get('message', '')))}")
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
