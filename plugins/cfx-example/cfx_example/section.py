"""A section of the report. This one says how many frames each job was tested on.

`cfx report` calls `context` once for its page, and fills the template with what it gives; a section
that gives None is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cfx.plugin import Result
from cfx_report.jobs import Runs
from cfx_report.section import Cell, Column, Section, Sheet, number


def name(job: Result) -> str:
    """Returns what a job is called in the report."""
    return job.name


def frames(job: Result) -> Cell:
    """Returns how many frames of all pairs were tested."""
    return number(job.pairs.query("method == 'default'")["frames"].sum(), ".0f")


class FrameCounts(Section):
    """A row per job."""

    title = "Frames of the test parts"
    entry = "Frames"
    order = 250
    template = """
    <p>Frames that are compared.</p>
    {{ table(sheet, explain=true) }}
    """

    def context(self, runs: Runs) -> Mapping[str, Any]:
        columns: tuple[Column[Result], ...] = (
            Column("Job", name),
            Column("Frames", frames, "Over all pairs."),
        )
        return {"sheet": Sheet.of(columns, runs.jobs)}
