"""Jobs that MLflow keeps."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from cfx.core.errors import TrackingError
from cfx.report.job import Origin, Unfinished
from cfx.results.store import (
    download_run,
    is_run_id,
    open_store,
    sqlite_file,
    tracking_uri,
    translate_errors,
)

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
