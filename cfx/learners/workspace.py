"""The workspace of a job: files from which it goes on with training that it had begun, or ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Workspace:
    """Files from which interrupted training goes on, until the job that asked for it is done.

    Training that has ended keeps them too: what a job does next, such as simulating forecasts, may
    take hours, and whoever interrupts it there trains nothing again.

    Attributes:
        folder: of many jobs; a file's name says which training it belongs to.
        files: of this job.
    """

    folder: Path
    files: set[Path] = field(default_factory=set)

    def file(self, name: str) -> Path:
        """Returns the file of this name, which need not be there; `clear` removes it."""
        path = self.folder / name
        self.files.add(path)
        return path

    def clear(self) -> None:
        """Removes the files of this job."""
        for path in self.files:
            path.unlink(missing_ok=True)
        self.files.clear()
