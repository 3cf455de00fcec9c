"""What a sweep is: the file in its folder that says so, and the jobs that belong to it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

from cfx.app.sweep.status import STATUS, JobStatus
from cfx.core.files import write_json

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
