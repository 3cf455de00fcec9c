"""How much burn-in the policy needs."""

from __future__ import annotations

from collections.abc import Sequence

from cfx.report.blocks import Block, Group, Heading, Table, Text, cards
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.figures.history import history_curves
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, interval, number, share, text

_NAME = "history"


class HistorySection(Section):
    """How much burn-in the policy needs."""

    title = "How much history the policy needs"
    entry = "History"
    order = 1000

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a plot for each job that varied the history, and a table."""
        jobs = [job for job in runs.jobs if "history" in job.tables]
        if not jobs:
            return []
        groups = []
        for job in jobs:
            figure = figure_of(_NAME, job)
            if figure is not None:
                groups.append(Group((Heading(job.name), figure), "card"))
        return [Text(caption(_NAME)), *cards(groups), Table(histories(jobs))]


def histories(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job, base and amount."""
    columns = (
        Column("Job", number=False),
        Column("Base", "What the policy's answers are offsets from.", number=False),
        Column(
            "Burn-in",
            "Measured history before the test part; a share is of the full trajectory.",
            number=False,
        ),
        Column(
            "Mean",
            "Mean improvement of the RMSE of speed over driver-specific calibration, test part.",
        ),
        Column(
            "95 % interval",
            "Bootstrap confidence interval of the mean; drivers are resampled, each with all their"
            " pairs.",
        ),
        Column("Pairs", "Pairs whose improvement is defined."),
    )
    rows: list[tuple[Cell, ...]] = []
    for job in jobs:
        if "history" not in job.tables:
            continue
        for curve in history_curves(job.tables["history"]):
            for k, amount in enumerate(curve.amounts):
                rows.append(
                    (
                        text(job.name),
                        text(curve.label),
                        text(amount),
                        share(float(curve.mean[k])),
                        interval(float(curve.low[k]), float(curve.high[k])),
                        number(curve.pairs[k], str(curve.pairs[k])),
                    )
                )
    return Sheet(columns, tuple(rows))
