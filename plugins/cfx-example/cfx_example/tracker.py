"""A tracker: where the runs of jobs are kept. This one writes lines of JSON into one file.

A job opens its `run` at the start and logs into it at the end, a sweep calls `end_sweep`, and
commands such as `cfx report RUN` find a job's folder through the other methods.

The file is `tracking.uri`, by default `run_list.jsonl` where the job was started.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.errors import TrackingError
from cfx.plugin import Origin, Tracker, Tracking

if TYPE_CHECKING:
    # `cfx drive` asks trackers for runs in SUMO's process, which has no pyarrow; results need it.
    from cfx.plugin import JobConfig, Result

FILE = "run_list.jsonl"
PREFIX = "run_list-"


class FileTracker(Tracker):
    """The run of one job."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.file = file
        self.folder = folder.absolute()
        # The same folder gives the same run: a job that starts again goes on in it.
        self.run_id = PREFIX + hashlib.sha256(str(self.folder).encode()).hexdigest()[:12]
        self.tags: dict[str, str] = {}
        self.metrics: dict[str, float] = {}

    def set_tags(self, tags: Mapping[str, str]) -> None:
        self.tags.update(tags)

    def log_job(self, result: Result, description: str) -> None:
        self.metrics.update(result.metrics)

    def how_to_open(self) -> tuple[str, ...]:
        return (f"Run {self.run_id} in {self.file}",)

    def write(self, status: str) -> None:
        """Adds a line to the file.

        Raises:
            TrackingError: the file cannot be written.
        """
        line = {
            "run": self.run_id,
            "folder": str(self.folder),
            "status": status,
            "tags": self.tags,
            "metrics": self.metrics,
        }
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with self.file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(line) + "\n")
        except OSError as error:
            raise TrackingError(
                f"{self.file}: the run cannot be written ({error.strerror or error}); name another"
                " file with tracking.uri, or set tracking.enabled=false"
            ) from error


class RunList(Tracking):
    """Keeps runs as lines of a file; the last line of a run counts."""

    def run(self, config: JobConfig, folder: Path) -> AbstractContextManager[Tracker]:
        return _run(FileTracker(_file(config.tracking.uri), folder))

    def end_sweep(self, settings: Mapping[str, Any], sweep: str) -> tuple[str, ...]:
        return (f"Runs are in {_file(settings.get('uri'))}",)

    def is_run_id(self, text: str) -> bool:
        return text.startswith(PREFIX)

    def folder_of_run(self, run_id: str, uri: str | None = None) -> Path:
        line = _last_line(_file(uri), run_id)
        folder = Path(line["folder"])
        if not folder.is_dir():
            raise TrackingError(f"the folder of run {run_id}, {folder}, is gone")
        return folder

    def jobs_of_run(self, run_id: str) -> list[Origin]:
        line = _last_line(_file(None), run_id)
        place = f"run {run_id}"
        if line["status"] != "finished":
            return [Origin(place, reason=f"it is {line['status']}")]
        return [Origin(place, self.folder_of_run(run_id))]


@contextmanager
def _run(tracker: FileTracker) -> Iterator[FileTracker]:
    """Writes that a job has begun, and how it has ended."""
    tracker.write("running")
    status = "failed"
    try:
        yield tracker
        status = "finished"
    finally:
        tracker.write(status)


def _file(uri: str | None) -> Path:
    return Path(uri or FILE).expanduser().absolute()


def _last_line(file: Path, run_id: str) -> dict[str, Any]:
    """Returns the last line about a run.

    Raises:
        TrackingError: there is none, or the file cannot be read.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
        for text in reversed(lines):
            line: dict[str, Any] = json.loads(text)
            if line["run"] == run_id:
                return line
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise TrackingError(
            f"{file} is no list of runs ({error}); start cfx in the folder of {FILE}"
        ) from error
    raise TrackingError(f"{file} has no run {run_id}; give the id that a job printed")
