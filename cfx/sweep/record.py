"""What a sweep is: the file in its folder that says so, and the jobs that belong to it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

from cfx.files import write_json
from cfx.sweep.status import STATUS, JobStatus

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
        """Returns, by folder and in the sweep's order, the jobs that this start has seen and those that were done before."""
        found = {
            path.parent: JobStatus.read(path.parent)
            for path in sorted(folder.rglob(STATUS))
            if _is_in(path.parent, folder)
        }
        ours = {
            path: status if status.multirun == multirun else replace(status, before=True)
            for path, status in found.items()
            if status is not None
            and (
                status.multirun == multirun
                or (status.code == 0 and status.command == self.command_hash)
            )
        }
        return dict(sorted(ours.items(), key=lambda item: item[1].number))


def _is_in(job: Path, sweep: Path) -> bool:
    """Says whether a folder below a sweep's belongs to it, and not to another sweep below."""
    between = job.relative_to(sweep).parents
    return not any(
        (sweep / one / RECORD).exists() for one in [job.relative_to(sweep), *between][:-1]
    )
