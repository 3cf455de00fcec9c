"""Learning curves."""

from __future__ import annotations

from cfx.report.blocks import (
    MOST,
    Block,
    Group,
    Heading,
    Text,
    cards,
    missing_file,
)
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.figures.words import plural
from cfx.report.job import Runs
from cfx.report.section import Section

_NAME = "learning_curve"


class LearningSection(Section):
    """Learning curves."""

    title = "Learning curves"
    entry = "Learning curves"
    order = 1800

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a plot for each job that learned something."""
        groups, without = [], []
        for job in runs.jobs:
            table = job.tables.get("curves")
            if table is None:
                continue
            if not len(table):
                without.append(job.name)
                continue
            networks = int(table["network"].nunique())
            heading = Heading(job.name, f"({plural(networks, 'network')})")
            figure = figure_of(_NAME, job)
            if figure is not None:
                groups.append(Group((heading, figure), "card"))
        found: list[Block] = [Text(caption(_NAME)), *cards(groups)]
        if without:
            named = ", ".join(without) if len(without) <= MOST else f"{len(without)} jobs"
            found.append(Text(f"Nothing was learned in {named}.", "fine"))
        return [*found, *missing_file(runs, "curves.parquet", "the learning curves")]
