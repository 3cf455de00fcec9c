"""Figures of other distributions."""

from __future__ import annotations

from cfx.core.registry import OWN
from cfx.report.blocks import Block, Heading, Section, Text, job_fold
from cfx.report.figure_blocks import figure_of
from cfx.report.figures.figure import installed
from cfx.report.job import Runs


def blocks(runs: Runs) -> list[Block]:
    """Returns each figure that another distribution brings, of each job that has its data."""
    found: list[Block] = []
    for one in installed():
        if one.distribution == OWN:
            continue
        folds: list[Block] = []
        for job in runs.jobs:
            figure = figure_of(one.name, job)
            if figure is not None:
                folds.append(job_fold(job.name, [figure], first=not folds))
        if folds:
            found += [Heading(one.figure.title), Text(one.figure.caption), *folds]
    return found


SECTION = Section("further", "Further figures", "Further figures", blocks)
