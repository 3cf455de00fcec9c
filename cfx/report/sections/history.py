"""How much burn-in the policy needs."""

from __future__ import annotations

from collections.abc import Sequence

from cfx.report.blocks import Block, Group, Heading, Table, Text, cards
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.figures.history import BASE_LABELS, history_curves
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, interval, number, share, text


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
            figure = figure_of("history", job)
            if figure is not None:
                groups.append(Group((Heading(job.name), figure), "card"))
        return [Text(caption("history")), *cards(groups), Table(histories(jobs))]


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
        for one in history_curves(job.tables["history"]).to_dict("records"):
            base = BASE_LABELS.get(one["base"], one["base"])
            named = (text(job.name), text(base), text(one["amount"]))
            pairs = number(one["pairs"], str(one["pairs"]))
            rows.append((*named, share(one["mean"]), interval(one["low"], one["high"]), pairs))
    return Sheet(columns, tuple(rows))
