"""How errors grow from the measured state on."""

from __future__ import annotations

from cfx.report.blocks import Block, Section, Text, job_fold
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.job import Runs

_NAME = "error_over_time"


def blocks(runs: Runs) -> list[Block]:
    """Returns a figure for each job that kept its trajectories."""
    found: list[Block] = []
    for job in runs.jobs:
        figure = figure_of(_NAME, job)
        if figure is not None:
            found.append(job_fold(job.name, [figure], first=not found))
    return [Text(caption(_NAME)), *found] if found else []


SECTION = Section("errors", "Errors over time", "Errors over time", blocks)
