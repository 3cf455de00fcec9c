"""Figures of other distributions that no section shows."""

from __future__ import annotations

from cfx.core.registry import OWN
from cfx.report.blocks import Block, Heading, Text, job_fold
from cfx.report.figure_blocks import figure_of
from cfx.report.figures.figure import JobFigure
from cfx.report.job import Runs
from cfx.report.section import Section


class FurtherSection(Section):
    """Figures of other distributions that no section shows."""

    title = "Further figures"
    entry = "Further figures"
    order = 1900

    def blocks(self, runs: Runs) -> list[Block]:
        """Return each such figure, of each job that has its data."""
        shown: set[str] = set()
        for section in Section.installed():
            shown |= set(section.part.figures)
        found: list[Block] = []
        for one in JobFigure.installed():
            if one.distribution == OWN or one.name in shown:
                continue
            folds: list[Block] = []
            for job in runs.jobs:
                figure = figure_of(one.name, job)
                if figure is not None:
                    folds.append(job_fold(job.name, [figure], first=not folds))
            if folds:
                found += [Heading(one.part.title), Text(one.part.caption), *folds]
        return found
