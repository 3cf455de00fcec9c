"""How errors grow from the measured state on."""

from __future__ import annotations

from cfx.report.blocks import Block, Text, job_fold
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.job import Runs
from cfx.report.section import Section

_NAME = "error_over_time"


class ErrorsSection(Section):
    """How errors grow from the measured state on."""

    title = "Errors over time"
    entry = "Errors over time"
    order = 1700

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a figure for each job that kept its trajectories."""
        found: list[Block] = []
        for job in runs.jobs:
            figure = figure_of(_NAME, job)
            if figure is not None:
                found.append(job_fold(job.name, [figure], first=not found))
        return [Text(caption(_NAME)), *found] if found else []
