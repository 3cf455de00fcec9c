"""A section of the report. This one says how fast the drivers of each job were.

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
    """Returns how many frames were measured."""
    return number(job.tables["speed_bins"]["frames"].sum(), ".0f")


def highest(job: Result) -> Cell:
    """Returns the lower end of the highest bin of speed."""
    return number(job.tables["speed_bins"]["speed"].max(), ".0f")


class MeasuredSpeeds(Section):
    """A row for each job that has the table `speed_bins`."""

    title = "Measured speeds"
    entry = "Speeds"
    order = 250
    template = """
    <p>The speeds of the followers, as they were recorded.</p>
    {{ table(sheet, explain=true) }}
    """

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        jobs = [job for job in runs.jobs if "speed_bins" in job.tables]
        if not jobs:
            return None
        columns: tuple[Column[Result], ...] = (
            Column("Job", name),
            Column("Frames", frames, "Over all pairs."),
            Column("Highest (m/s)", highest, "The lower end of the highest bin, 1 m/s wide."),
        )
        return {"sheet": Sheet.of(columns, jobs)}
