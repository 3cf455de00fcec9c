"""How much closer the policy drives, and the errors of each method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from cfx.evaluation.metrics.base import SCOPES
from cfx.evaluation.result import Purpose
from cfx.report.blocks import Block, Figure, Heading, Table, Text
from cfx.report.figure_blocks import view
from cfx.report.figures.jobs import Statistics, draw_overview, statistics_axis
from cfx.report.figures.words import FULL_TRAJECTORY, MINUS, TEST, label
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.section import Section
from cfx.report.tables import (
    Cell,
    Column,
    Sheet,
    formatted,
    interval,
    method_cell,
    methods_explained,
    number,
    probability,
    share,
    tested,
    text,
)


class ResultsSection(Section):
    """How much closer the policy drives, and the errors of each method."""

    title = "Results"
    entry = "Results"
    order = 400

    def blocks(self, runs: Runs) -> list[Block]:
        """Return improvements over each baseline, and errors."""
        jobs = runs.jobs
        found: list[Block] = []
        if of_purpose(jobs, Purpose.ADAPTATION):
            words = (
                "Mean improvement of the RMSE of speed over each baseline, with its 95 % interval."
                " Where the interval contains 0, the job does not tell whether the policy helps."
            )
            found += [
                Heading("How much closer the policy drives"),
                Text(words),
                overview(jobs),
                Table(improvements(jobs), explain=True),
            ]
        return [*found, Heading("Errors of each method"), Table(errors(jobs), explain=True)]


def overview(jobs: Sequence[Job]) -> Figure:
    """Mean improvement with its 95 % interval; a view per baseline and part of the trajectories."""
    views = {}
    for scope in SCOPES:
        suffix = "" if scope == TEST else f", {jobs[0].scope_label(scope)}"
        for baseline in any_baselines(jobs, scope):
            rows = []
            for job in jobs:
                if baseline in job.baselines(scope):
                    rows.append(_statistics(job, baseline, scope))
            axis = statistics_axis(rows, baseline)
            drawn = draw_overview(rows, baseline, axis)
            views[f"against {label(baseline)}{suffix}"] = view(drawn, axis.note)
    title = "Mean improvement of each job with its 95 % interval"
    return Figure(views, title)


def errors(jobs: Sequence[Job]) -> Sheet:
    """Returns the errors: a row per job and method. The numbers are those of `metrics.json`."""
    methods: list[str] = []
    for job in jobs:
        methods += job.methods
    columns = [
        Column("Job", number=False),
        Column("Method", methods_explained(methods), number=False),
        Column("Pairs", "Pairs of a leader and a follower; the means are taken over them."),
        Column(
            "RMSE of speed (m/s)",
            "Root mean square difference between the simulated and the measured speed of the"
            f" follower over {tested(jobs)}, simulated in closed loop from the last measured state"
            " on: the simulation sees the leader, never the measured follower. Mean over the pairs."
            " Every method starts from the same state and covers the same frames.",
        ),
        Column("RMSE of gap (m)", "The same for the gap, bumper to bumper."),
        Column("Collisions", "Pairs in which the simulated gap becomes negative on these frames."),
    ]
    full = bool(any_baselines(jobs, FULL_TRAJECTORY))
    if full:
        columns += [
            Column(
                "Full trajectory: RMSE of speed (m/s)",
                "The same over the full trajectory of unseen drivers, from its first frame on."
                " Driver-specific calibration does not compete here.",
            ),
            Column("Full trajectory: RMSE of gap (m)", "The same for the gap."),
        ]
    rows = []
    for job in jobs:
        for method in job.meaningful_methods:
            rows.append(_error_row(job, method, full=full))
    return Sheet(tuple(columns), tuple(rows))


def _error_row(job: Job, method: str, *, full: bool) -> tuple[Cell, ...]:
    pairs = int((job.pairs["method"] == method).sum())
    collisions = job.metric("collisions", method)
    cells = [text(job.name), method_cell(method), number(pairs, str(pairs))]
    for name in ("rmse_speed", "rmse_gap"):
        value = job.metric(name, method)
        cells.append(number(value, f"{value:.3f}"))
    cells.append(number(collisions, f"{collisions:.0f}"))
    if full:
        for name in ("rmse_speed", "rmse_gap"):
            value = job.metric(name, method, FULL_TRAJECTORY)
            cells.append(number(value, f"{value:.3f}"))
    return tuple(cells)


def improvements(jobs: Sequence[Job]) -> Sheet:
    """Returns the policy's improvement: a row per job, baseline and part of the trajectories."""
    full = bool(any_baselines(jobs, FULL_TRAJECTORY))
    scopes = (TEST, FULL_TRAJECTORY) if full else (TEST,)
    baselines: list[str] = []
    for scope in scopes:
        baselines += any_baselines(jobs, scope)
    rows = []
    for scope in scopes:
        for baseline in dict.fromkeys(baselines):
            for job in jobs:
                if baseline in job.baselines(scope):
                    rows.append(_improvement_row(job, baseline, scope, full=full))
    return Sheet(_improvement_columns(jobs, baselines, full=full), tuple(rows))


def _improvement_columns(
    jobs: Sequence[Job], baselines: Sequence[str], *, full: bool
) -> tuple[Column, ...]:
    columns = [
        Column("Job", number=False),
        Column("Policy against", f"The baseline. {methods_explained(baselines)}", number=False),
    ]
    if full:
        frames = (
            f"The frames that count. Test part: {tested(jobs)}. Full trajectory: from the first"
            " frame on, of unseen drivers."
        )
        columns.append(Column("Frames", frames, number=False))
    return (
        *columns,
        Column(
            "Mean",
            f"Improvement of a pair: (RMSE of the baseline {MINUS} RMSE of the policy) / RMSE of"
            " the baseline, RMSE of the speed over these frames. Above 0 the policy is closer to"
            " the real driver. Here the mean over the pairs.",
        ),
        Column(
            "95 % interval",
            "Bootstrap confidence interval of that mean; drivers are resampled, each with all their"
            " pairs.",
        ),
        Column(
            "Trimmed mean",
            "Mean without the top and the bottom tenth of the pairs, as the paper averages.",
        ),
        Column("Median", "Half of the pairs improve more."),
        Column("Better for", "Share of the pairs with an improvement above 0."),
        Column(
            "p",
            "Two-sided Wilcoxon signed-rank test of the baseline's RMSE against the policy's, means"
            " over each driver's pairs.",
        ),
        Column(
            "Pairs",
            "Pairs that count. One does not if the baseline has no error or a simulation diverges.",
        ),
    )


def _improvement_row(job: Job, baseline: str, scope: str, *, full: bool) -> tuple[Cell, ...]:
    cells = [text(job.name), method_cell(baseline)]
    if full:
        frames = "test part" if scope == TEST else "full trajectory"
        cells.append(text(frames.replace(" ", "\N{NO-BREAK SPACE}")))
    one = _statistics(job, baseline, scope)
    better = job.improvement("win_rate", baseline, scope)
    p_value = job.improvement("p_value", baseline, scope)
    count = counted(job, baseline, scope)
    return (
        *cells,
        share(one.mean),
        interval(one.low, one.high),
        share(one.trimmed_mean),
        share(one.median),
        number(better, formatted(better, ".0%")),
        number(p_value, probability(p_value)),
        number(count, str(count)),
    )


def counted(job: Job, baseline: str, scope: str = TEST) -> int:
    """Returns the number of pairs whose improvement over a baseline is defined."""
    nothing = pd.Series(dtype=float)
    if scope == TEST:
        return int(np.isfinite(job.by_pair.get(f"improvement/{baseline}", nothing)).sum())
    column = f"{scope}_rmse_speed"
    if column not in job.pairs:
        return 0
    speeds = job.pairs.pivot_table(
        index="pair_id", columns="method", values=column, aggfunc="first"
    )
    before, after = speeds.get(baseline, nothing), speeds.get("policy", nothing)
    return int((np.isfinite(before) & np.isfinite(after) & (before > 0)).sum())


def _statistics(job: Job, baseline: str, scope: str) -> Statistics:
    return Statistics(
        job=job.name,
        mean=job.improvement("mean", baseline, scope),
        low=job.improvement("ci95_low", baseline, scope),
        high=job.improvement("ci95_high", baseline, scope),
        trimmed_mean=job.improvement("trimmed_mean", baseline, scope),
        median=job.improvement("median", baseline, scope),
    )
