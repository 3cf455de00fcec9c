"""MLflow as the place that keeps jobs' runs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.errors import TrackingError
from cfx.results.mlflow import store
from cfx.results.tracker import Origin, Tracker, Tracking

if TYPE_CHECKING:
    from cfx.results.config import JobConfig

_MOST = 1000
"""Most jobs of one sweep that are asked for."""


class MlflowTracking(Tracking):
    """One run for each job, nested under one for each multirun."""

    def run(self, config: JobConfig, folder: Path) -> AbstractContextManager[Tracker]:
        from cfx.results.mlflow.tracker import MlflowTracker

        return MlflowTracker.of_job(config, folder)

    def end_sweep(self, settings: Mapping[str, Any], sweep: str) -> tuple[str, ...]:
        uri = store.tracking_uri(settings.get("uri"))
        file = store.sqlite_file(uri)
        if file is not None and not file.is_file():
            return ()
        from cfx.results.mlflow.tracker import end_sweep

        return end_sweep(uri, str(settings.get("experiment")), sweep)

    def is_run_id(self, text: str) -> bool:
        return store.is_run_id(text)

    def folder_of_run(self, run_id: str, uri: str | None = None) -> Path:
        return store.download_run(run_id, uri)

    def jobs_of_run(self, run_id: str) -> list[Origin]:
        uri = store.tracking_uri(None)
        file = store.sqlite_file(uri)
        if not store.is_run_id(run_id) or (file is not None and not file.is_file()):
            # It says what is wrong with the id or the store.
            return [Origin(run_id, store.download_run(run_id))]
        opened = store.open_store(uri, "cfx")
        with store.translate_errors(f"read run {run_id} from {uri}"):
            run = opened.client.get_run(run_id)
            sweep = run.data.tags.get("cfx.sweep_parent")
            if sweep is None:
                return [_tracked(run)]
            jobs = opened.client.search_runs(
                [run.info.experiment_id], f"tags.`cfx.sweep` = '{sweep}'", max_results=_MOST
            )
        if not jobs:
            raise TrackingError(f"run {run_id} is the parent of a sweep without any job")
        return [_tracked(job) for job in sorted(jobs, key=lambda job: job.info.start_time or 0)]


def _tracked(run: Any) -> Origin:
    tags, info = run.data.tags, run.info
    place = f"MLflow run {info.run_id}"
    if info.status != "FINISHED":
        reason = tags.get("cfx.failure") or f"not finished: MLflow says {info.status}"
        return Origin(place, reason=reason)
    # Where the job ran on this machine, its folder tells what was typed; MLflow does not keep that.
    there = Path(tags.get("cfx.folder", ""))
    is_there = tags.get("cfx.folder") and (there / "metrics.json").is_file()
    return Origin(
        place,
        store.download_run(info.run_id),
        started=datetime.fromtimestamp(info.start_time / 1000),
        seconds=(info.end_time - info.start_time) / 1000 if info.end_time else None,
        version=tags.get("cfx.version", ""),
        hydra=there if is_there else None,
    )
