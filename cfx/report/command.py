"""What `cfx report` does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cfx.plots.words import plural
from cfx.report.page import write_report
from cfx.report.runs import read_runs

NAME = "report.html"


def report(runs: Sequence[str], output: str | None = None, title: str | None = None) -> list[str]:
    """Writes the report about some jobs; returns what to tell the user.

    Args:
        runs: as `read_runs` takes them.
        output: the file; None for `report.html` in the only folder that was given, else in the
            current one.
        title: of the page; None for one that names the driving models.

    Raises:
        DataError, TrackingError: the jobs cannot be read.
        OutputError: the page cannot be written.
    """
    found = read_runs(runs)
    folder = Path(runs[0]).expanduser()
    home = folder if len(runs) == 1 and folder.is_dir() else Path()
    path = write_report(found, Path(output).expanduser() if output else home / NAME, title)
    left_out = ""
    if found.unfinished:
        left_out = f"; {len(found.unfinished)} unfinished ones are named in it"
    return [f"Report of {plural(len(found.jobs), 'job')}{left_out}: {path.absolute()}"]
