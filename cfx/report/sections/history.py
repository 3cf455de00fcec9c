"""How much burn-in the policy needs."""

from __future__ import annotations

from collections.abc import Sequence

from cfx.plots.choice.history import amounts_of, history_curves
from cfx.plots.plotly.figure import Plot
from cfx.plots.plotly.history import history_plot
from cfx.report.blocks import Block, Figure, Group, Heading, Section, Table, Text, cards
from cfx.report.job import Job, Runs
from cfx.report.tables import Cell, Column, Sheet, interval, number, share, text

_INTRODUCTION = (
    "Before the test part, the policy is fed with measured history of the driver, its burn-in. Here"
    " the same test part after less and after more of it: mean improvement over driver-specific"
    " calibration, with its 95 % interval."
)


def blocks(runs: Runs) -> list[Block]:
    """Returns a plot for each job that varied the history, and a table."""
    jobs = [job for job in runs.jobs if job.history is not None]
    if not jobs:
        return []
    groups = []
    for job in jobs:
        groups.append(Group((Heading(job.name), Figure(history(job))), "card"))
    return [Text(_INTRODUCTION), *cards(groups), Table(histories(jobs))]


def history(job: Job) -> Plot:
    """Improvement of a job by the amount of burn-in; a line per base."""
    assert job.history is not None
    return history_plot(history_curves(job.history), amounts_of(job.history))


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
        if job.history is None:
            continue
        for curve in history_curves(job.history):
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


SECTION = Section("history", "How much history the policy needs", "History", blocks)
