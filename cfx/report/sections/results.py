"""How much closer the policy drives, and the errors of each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from cfx.evaluation.metrics.base import SCOPES
from cfx.evaluation.result import Purpose
from cfx.evaluation.statistics import Improvement
from cfx.report.figures.jobs import draw_overview, statistics_axis
from cfx.report.figures.text import FULL_TRAJECTORY, MINUS, TEST, label
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.section import Section, View
from cfx.report.tables import (
    Cell,
    Column,
    Sheet,
    interval,
    method_cell,
    methods_explained,
    number,
    tested,
)


class ResultsSection(Section):
    """How much closer the policy drives, and the errors of each method."""

    title = "Results"
    entry = "Results"
    order = 400
    template = """
{% if compared %}
<h3>How much closer the policy drives</h3>
<p>Mean improvement of the RMSE of speed over each baseline, with its 95 % interval. Where the
interval contains 0, the job does not tell whether the policy helps.</p>
{{ figure(overview, "Mean improvement of each job with its 95 % interval") }}
{{ table(improvements, explain=true) }}
{% endif %}
<h3>Errors of each method</h3>
{{ table(errors, explain=true) }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return improvements over each baseline, and errors."""
        jobs = runs.jobs
        return {
            "compared": of_purpose(jobs, Purpose.ADAPTATION),
            "overview": overview(jobs),
            "improvements": improvements(jobs),
            "errors": errors(jobs),
        }


def overview(jobs: Sequence[Job]) -> dict[str, View]:
    """Mean improvement with its 95 % interval; a view per baseline and part of the trajectories."""
    views = {}
    for scope in SCOPES:
        suffix = "" if scope == TEST else f", {jobs[0].scope_label(scope)}"
        for baseline in any_baselines(jobs, scope):
            found = {}
            for job in jobs:
                if baseline in job.baselines(scope):
                    found[job.name] = job.statistics(baseline, scope)
            axis = statistics_axis(found.values(), baseline)
            drawn = draw_overview(found, baseline, axis)
            views[f"against {label(baseline)}{suffix}"] = View(drawn, axis.note)
    return views


class _Tested(NamedTuple):
    job: Job
    method: str

    @property
    def pairs(self) -> int:
        return int((self.job.pairs["method"] == self.method).sum())


def errors(jobs: Sequence[Job]) -> Sheet:
    """Returns the errors: a row per job and method. The numbers are those of `metrics.json`."""
    rows: list[_Tested] = []
    methods: list[str] = []
    for job in jobs:
        methods += job.methods
        rows += [_Tested(job, method) for method in job.meaningful_methods]
    columns = [
        Column[_Tested]("Job", lambda row: row.job.name),
        Column("Method", lambda row: method_cell(row.method), methods_explained(methods)),
        Column(
            "Pairs",
            lambda row: number(row.pairs, "d"),
            "Pairs of a leader and a follower; the means are taken over them.",
        ),
        Column(
            "RMSE of speed (m/s)",
            partial(_metric, "rmse_speed"),
            "Root mean square difference between the simulated and the measured speed of the"
            f" follower over {tested(jobs)}, simulated in closed loop from the last measured state"
            " on: the simulation sees the leader, never the measured follower. Mean over the pairs."
            " Every method starts from the same state and covers the same frames.",
        ),
        Column(
            "RMSE of gap (m)",
            partial(_metric, "rmse_gap"),
            "The same for the gap, bumper to bumper.",
        ),
        Column(
            "Collisions",
            partial(_metric, "collisions", form=".0f"),
            "Pairs in which the simulated gap becomes negative on these frames.",
        ),
    ]
    if any_baselines(jobs, FULL_TRAJECTORY):
        columns += [
            Column(
                "Full trajectory: RMSE of speed (m/s)",
                partial(_metric, "rmse_speed", scope=FULL_TRAJECTORY),
                "The same over the full trajectory of unseen drivers, from its first frame on."
                " Driver-specific calibration does not compete here.",
            ),
            Column(
                "Full trajectory: RMSE of gap (m)",
                partial(_metric, "rmse_gap", scope=FULL_TRAJECTORY),
                "The same for the gap.",
            ),
        ]
    return Sheet.of(columns, rows)


def _metric(name: str, row: _Tested, form: str = ".3f", scope: str = TEST) -> Cell:
    return number(row.job.metric(name, row.method, scope), form)


class _Compared(NamedTuple):
    job: str
    baseline: str
    scope: str
    found: Improvement


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
                    found = job.statistics(baseline, scope)
                    rows.append(_Compared(job.name, baseline, scope, found))
    columns = [
        Column[_Compared]("Job", lambda row: row.job),
        Column(
            "Policy against",
            lambda row: method_cell(row.baseline),
            f"The baseline. {methods_explained(baselines)}",
        ),
    ]
    if full:
        frames = (
            f"The frames that count. Test part: {tested(jobs)}. Full trajectory: from the first"
            " frame on, of unseen drivers."
        )
        columns.append(Column("Frames", _frames, frames))
    return Sheet.of([*columns, *_STATISTICS], rows)


def _frames(row: _Compared) -> str:
    said = "test part" if row.scope == TEST else "full trajectory"
    return said.replace(" ", "\N{NO-BREAK SPACE}")


def _p_value(row: _Compared) -> Cell:
    value = row.found.p_value
    cell = number(value, ".2g")
    return replace(cell, text="< 0.0001") if value < 1e-4 else cell


_STATISTICS: tuple[Column[_Compared], ...] = (
    Column(
        "Mean",
        lambda row: number(row.found.mean, "+.1%"),
        f"Improvement of a pair: (RMSE of the baseline {MINUS} RMSE of the policy) / RMSE of the"
        " baseline, RMSE of the speed over these frames. Above 0 the policy is closer to the real"
        " driver. Here the mean over the pairs.",
    ),
    Column(
        "95 % interval",
        lambda row: interval(row.found.ci95_low, row.found.ci95_high),
        "Bootstrap confidence interval of that mean; drivers are resampled, each with all their"
        " pairs.",
    ),
    Column(
        "Trimmed mean",
        lambda row: number(row.found.trimmed_mean, "+.1%"),
        "Mean without the top and the bottom tenth of the pairs, as the paper averages.",
    ),
    Column(
        "Median",
        lambda row: number(row.found.median, "+.1%"),
        "Half of the pairs improve more.",
    ),
    Column(
        "Better for",
        lambda row: number(row.found.win_rate, ".0%"),
        "Share of the pairs with an improvement above 0.",
    ),
    Column(
        "p",
        _p_value,
        "Two-sided Wilcoxon signed-rank test of the baseline's RMSE against the policy's, means"
        " over each driver's pairs.",
    ),
    Column(
        "Pairs",
        lambda row: number(row.found.pairs, "d"),
        "Pairs that count. One does not if the baseline has no error or a simulation diverges.",
    ),
)
