"""Tracking of jobs: what a service that keeps runs, such as MLflow, has to do."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from cfx.core import registry
from cfx.core.storage import is_url, local_folder
from cfx.errors import PluginError
from cfx.policies.ready import folder_of_ready_made, is_ready_made

if TYPE_CHECKING:
    from cfx.results.config import JobConfig
    from cfx.results.result import Result

log = logging.getLogger(__name__)

MLFLOW = "mlflow"
"""The tracking that jobs have unless they name another."""


class Tracker:
    """The run of a job, as the job writes to it; `tracked` opens the one that fits.

    This base class is for jobs that are not tracked: it drops everything.
    """

    run_id: str = ""

    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Adds tags to the run."""

    def log_job(self, result: Result, description: str) -> None:
        """Logs the results of a job whose folder is complete.

        Args:
            result: the results.
            description: of the job, in Markdown, for the page of its run.
        """

    def how_to_open(self) -> tuple[str, ...]:
        """Returns lines that tell a user where to look."""
        return ()


@dataclass(frozen=True)
class Origin:
    """Where a job comes from, and what is known of it besides its files.

    Attributes:
        place: what people know it by, such as "MLflow run 0a1b...".
        folder: a folder with its files; None if it did not finish.
        reason: why it did not finish.
        started: when it started.
        seconds: how long it took, s; None if that is not known.
        version: of cfx.
        hydra: the folder that the job wrote, whose `.hydra` holds what was typed; None if it is no
            longer on this machine.
    """

    place: str
    folder: Path | None = None
    reason: str = ""
    started: datetime | None = None
    seconds: float | None = None
    version: str = ""
    hydra: Path | None = None


class Tracking(ABC):
    """Base of every place that keeps the runs of jobs.

    An entry point of the group `cfx.trackers` makes it known: `tracking.name=NAME`.
    """

    @abstractmethod
    def run(self, config: JobConfig, folder: Path) -> AbstractContextManager[Tracker]:
        """Opens the run of a job, for as long as the job lasts.

        A job that was broken off and starts again with the same configuration in the same folder
        goes on in its old run. The run says how its body ended.

        Raises:
            TrackingError: the place cannot be used; raised before the job's work begins.
        """

    @abstractmethod
    def end_sweep(self, settings: Mapping[str, Any], sweep: str) -> tuple[str, ...]:
        """Closes runs that killed jobs of a multirun left open; returns lines that say where.

        `settings` are those of `tracking`, and `sweep` is the name that the jobs share.

        Raises:
            TrackingError: the place cannot be used.
        """

    @abstractmethod
    def is_run_id(self, text: str) -> bool:
        """Says whether this could be the id of a run."""

    @abstractmethod
    def folder_of_run(self, run_id: str, uri: str | None = None) -> Path:
        """Returns a folder with the files of a tracked job.

        They are those that a job's folder has, such as `metrics.json`, `pairs.csv` and `policy/`.
        `uri` is as `tracking.uri`.

        Raises:
            TrackingError: there is no such run, or its files are gone.
        """

    @abstractmethod
    def jobs_of_run(self, run_id: str) -> list[Origin]:
        """Returns the job of a run; of a sweep's run, its jobs, the earliest first.

        Raises:
            TrackingError: as `folder_of_run`.
        """


def tracking_named(name: str) -> Tracking:
    """Returns the tracking of a name.

    Raises:
        PluginError: it is not installed, or cannot be imported.
    """
    return cast("type[Tracking]", registry.get("tracker", name))()


@contextmanager
def tracked(config: JobConfig, folder: Path) -> Iterator[Tracker]:
    """Opens the run of a job, if the configuration asks for one; as `Tracking.run`.

    Raises:
        PluginError: the tracking that it names is not installed.
    """
    if not config.tracking.enabled:
        yield Tracker()
    else:
        with tracking_named(config.tracking.name).run(config, folder) as tracker:
            yield tracker


def tracking_of_run(text: str) -> Tracking:
    """Returns the first installed tracking whose ids of runs look like this; else MLflow.

    One that cannot be imported is warned of, and keeps nobody from the others' runs.
    """
    for name in registry.names("tracker"):
        try:
            tracking = tracking_named(name)
        except PluginError as error:
            log.warning("Runs of tracking.name=%s are not found: %s", name, error)
            continue
        if tracking.is_run_id(text):
            return tracking
    return tracking_named(MLFLOW)


def is_run_id(text: str) -> bool:
    """Says whether this could be the id of a run of an installed tracking."""
    return tracking_of_run(text).is_run_id(text)


def folder_of(folder_or_run: str | Path, uri: str | None = None) -> Path:
    """Returns the folder of a finished job, which may be given as the id of its run.

    Args:
        folder_or_run: a ready-made policy (`cfx://NAME`); the URL of a job's folder (`output.url`);
            an output folder, if it is there (`~` is the user's home); else a run.
        uri: as `tracking.uri`; None for `MLFLOW_TRACKING_URI`, else the database beside the
            outputs.

    Raises:
        DataError: there is no such ready-made policy, or nothing at the URL.
        TrackingError: it is no folder, and there is no such run, or its files are gone.
    """
    if is_ready_made(folder_or_run):
        return folder_of_ready_made(str(folder_or_run))
    if is_url(folder_or_run):
        return local_folder(str(folder_or_run))
    folder = Path(folder_or_run).expanduser()
    if folder.is_dir():
        return folder
    return tracking_of_run(str(folder_or_run)).folder_of_run(str(folder_or_run), uri)
