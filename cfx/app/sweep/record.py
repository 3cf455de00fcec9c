"""What a sweep is and how its jobs ended: the files in their folders that say so."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

from cfx.core.errors import DataError
from cfx.core.files import write_json

STATUS = "outcome.json"
"""The marker in a job's folder; written whole and last."""


@dataclass(frozen=True)
class JobStatus:
    """How a job of a sweep ended.

    Attributes:
        code: exit code: 0; 2 for a user's mistake; 1 for a bug.
        message: one sentence for people; empty if all went well.
        detail: the traceback of a bug.
        overrides: what was asked for.
        multirun: the start of the sweep that last saw this job.
        command: the sweep's command, see `Record.command_hash`.
        fingerprint: of everything that the results depend on, see `fingerprint`.
        number: the job's place in the sweep.
        seconds: how long it took, s.
        before: an earlier start of the sweep did it.
    """

    code: int
    message: str
    detail: str
    overrides: tuple[str, ...]
    multirun: str = ""
    command: str = ""
    fingerprint: str = ""
    number: int = 0
    seconds: float = 0.0
    before: bool = False

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Returns how the job in `folder` ended; None if it left no marker that can be read."""
        try:
            values = json.loads((folder / STATUS).read_text(encoding="utf-8"))
            return cls(**{**values, "overrides": tuple(values["overrides"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the job's folder."""
        write_json(folder / STATUS, asdict(self))

    @property
    def state(self) -> str:
        """For people: done, done before or failed."""
        if self.code:
            return "failed"
        if self.before:
            return "done before"
        return "done"


def metrics_of(folder: Path) -> dict[str, float]:
    """Returns the finite metrics of a finished job; empty if there are none."""
    from cfx.core.job_folder import read_metrics

    try:
        found = read_metrics(folder / "metrics.json")
    except DataError:
        return {}
    return {name: value for name, value in found.items() if math.isfinite(value)}


def worst(*codes: int) -> int:
    """Returns the exit code that weighs most: a signal, then a bug, then a user's mistake."""
    weights = {0: 0, 2: 1, 1: 2}
    return max(codes, key=lambda code: weights.get(code, 3))


RECORD = "sweep.json"
"""Says in a sweep's folder what the sweep is."""


@dataclass(frozen=True)
class Record:
    """What `sweep.json` says.

    Attributes:
        name: what the jobs share in MLflow; it stays when the sweep is continued from elsewhere.
        command: the overrides, as typed.
        command_hash: the same for the same overrides and values in any order.
        started: ISO 8601.
        jobs: how many there are, None if the sweeper decides as it goes.
        completed: ISO 8601; empty while jobs are missing or failed.
    """

    name: str
    command: tuple[str, ...]
    command_hash: str
    started: str
    jobs: int | None = None
    completed: str = ""

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Returns the record in a sweep's folder; None if there is none that can be read."""
        try:
            values = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            return cls(**{**values, "command": tuple(values["command"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the sweep's folder."""
        write_json(folder / RECORD, asdict(self))

    def statuses(self, folder: Path, multirun: str) -> dict[Path, JobStatus]:
        """Returns the jobs that this start has seen and those that were done before.

        Args:
            folder: of the sweep.
            multirun: this start of the sweep.

        Returns:
            How each job ended, by its folder and in the sweep's order.
        """
        found: dict[Path, JobStatus] = {}
        for marker in sorted(folder.rglob(STATUS)):
            job = marker.parent
            status = JobStatus.read(job)
            if status is None or not _belongs_to(job, folder):
                continue
            if status.multirun == multirun:
                found[job] = status
            elif status.code == 0 and status.command == self.command_hash:
                found[job] = replace(status, before=True)
        return dict(sorted(found.items(), key=lambda item: item[1].number))


def _belongs_to(job: Path, sweep: Path) -> bool:
    """Says whether a folder below a sweep's belongs to it, and not to another sweep below."""
    current = job
    while current != sweep:
        if (current / RECORD).exists():
            return False
        current = current.parent
    return True
