"""Finds the jobs that a user means: folders, sweeps, MLflow runs."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from cfx.errors import DataError
from cfx.report.names import named
from cfx.report.read import Job, Origin, Runs, Unfinished, read_job, read_json, without_password

_PASSED_OVER = {".hydra", "mlartifacts", "figures", "policy", "cache"}
"""Folders below an output folder that hold no jobs of their own."""


def read_runs(runs: Sequence[str]) -> Runs:
    """Reads jobs.

    Args:
        runs: each an output folder of a job, a folder with jobs below it, or the id of an MLflow run, also of a sweep's parent.

    Raises:
        DataError: a folder holds no finished job, or a job's file is damaged.
        TrackingError: there is no such run.
    """
    jobs: dict[str, Job] = {}
    unfinished: dict[str, Unfinished] = {}
    for run in runs:
        for found in (
            _of_folder(Path(run).expanduser())
            if Path(run).expanduser().exists()
            else _of_mlflow(run)
        ):
            if isinstance(found, Job):
                jobs.setdefault(found.place, found)
            else:
                unfinished.setdefault(found.place, found)
    return Runs(named(tuple(jobs.values())), tuple(unfinished.values()))


def _of_folder(folder: Path) -> list[Job | Unfinished]:
    if not folder.is_dir():
        raise DataError(
            f"{folder} is a file; give a job's output folder, a sweep's folder, or the id of an MLflow run"
        )
    found = [_one(place) for place in _job_folders(folder)]
    if not any(isinstance(one, Job) for one in found):
        why = "".join(
            f"; {one.place}: {one.reason}" for one in found if isinstance(one, Unfinished)
        )
        raise DataError(f"{folder} holds no finished job (a finished one has a metrics.json){why}")
    return found


def _of_mlflow(run: str) -> list[Job | Unfinished]:
    from cfx.report.tracked import tracked_runs  # imports MLflow

    found = [one if isinstance(one, Unfinished) else read_job(*one) for one in tracked_runs(run)]
    if not any(isinstance(one, Job) for one in found):
        why = "".join(
            f"; {one.place}: {one.reason}" for one in found if isinstance(one, Unfinished)
        )
        raise DataError(f"run {run} holds no finished job{why}")
    return found


def _job_folders(folder: Path) -> Iterator[Path]:
    """Yields the folders that a job was started in, `folder` itself or below it, in the order of their names."""
    for place, below, files in os.walk(folder):
        is_job = (
            bool({"metrics.json", "config.yaml", "outcome.json"} & set(files)) or ".hydra" in below
        )
        below[:] = (
            []
            if is_job
            else sorted((name for name in below if name not in _PASSED_OVER), key=_natural)
        )
        if is_job:
            yield Path(place)


def _natural(name: str) -> list[tuple[int, str]]:
    """Orders "2-w99" before "10-w99"."""
    return [
        (int(part), "") if part.isdigit() else (-1, part)
        for part in re.split(r"(\d+)", name)
        if part
    ]


def _one(folder: Path) -> Job | Unfinished:
    place = str(folder.absolute())
    if (folder / "metrics.json").is_file():
        return read_job(folder, Origin(place))
    status = read_json(folder / "outcome.json") if (folder / "outcome.json").is_file() else {}
    if status.get("code"):
        return Unfinished(place, f"failed: {without_password(str(status.get('message', '')))}")
    return Unfinished(place, "not finished: it has no metrics.json")
