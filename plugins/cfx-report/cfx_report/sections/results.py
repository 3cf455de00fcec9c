"""How much closer the policy drives, and the errors and metrics of each method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from cfx.plugin import OUTSIDE, SCOPES, Improvement, MetricInfo, Purpose, Result, wording
from cfx_report.figures.jobs import draw_overview, statistics_axis
from cfx_report.jobs import (
    Runs,
    any_baselines,
    are_calibrations,
    judge_of,
    metric_title,
    of_purpose,
)
from cfx_report.section import (
    Cell,
    Column,
    Section,
    Sheet,
    View,
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
<p>Improvement of {{ error }} over each baseline, geometric over drivers, with its 95 % interval.
Where the interval contains 0, the job does not tell whether the policy helps.</p>
{{ figure(overview, "Improvement of each job with its 95 % interval") }}
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
            "error": f"the {judge_of(jobs).heading}",
            "overview": overview(jobs),
            "improvements": improvements(jobs),
            "errors": errors(jobs),
        }


def overview(jobs: Sequence[Result]) -> dict[str, View]:
    """Improvement with its 95 % interval; a view per baseline and part of the trajectories."""
    views = {}
    for scope in SCOPES:
        suffix = "" if scope == wording.TEST else f", {jobs[0].scope_label(scope)}"
        for baseline in any_baselines(jobs, scope):
            improvements = {}
            for job in jobs:
                if baseline in job.baselines(scope):
                    improvements[job.name] = job.statistics(baseline, scope)
            axis = statistics_axis(improvements.values(), baseline)
            drawn = draw_overview(improvements, baseline, axis)
            views[f"against {wording.method_label(baseline)}{suffix}"] = View(drawn, axis.note)
    return views


class _Tested(NamedTuple):
    job: Result
    method: str

    @property
    def pairs(self) -> int:
        return int((self.job.pairs["method"] == self.method).sum())


def errors(jobs: Sequence[Result]) -> Sheet:
    """Returns the errors: a row per job and method. The numbers are those of `metrics.json`."""
    rows: list[_Tested] = []
    methods: list[str] = []
    for job in jobs:
        methods += job.methods
        rows += [_Tested(job, method) for method in job.shown_methods]
    judge = judge_of(jobs)
    leading: list[Column[_Tested]] = []
    if judge.name not in {"rmse_speed", "rmse_gap"}:
        cell = partial(_metric, judge.name)
        leading.append(Column(metric_title(judge), cell, f"{judge.meaning}."))
    columns: list[Column[_Tested]] = [
        Column("Job", lambda row: row.job.name),
        Column("Method", lambda row: method_cell(row.method), methods_explained(methods)),
        Column(
            "Pairs",
            lambda row: number(row.pairs, "d"),
            "Pairs of a leader and a follower; the means are taken over them.",
        ),
        *leading,
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
    if any("fits" in job.tables for job in jobs):
        columns += [
            Column(
                "Where calibrated: RMSE of speed (m/s)",
                partial(_fitted, "rmse_speed"),
                "The same over the part that driver-specific parameters were calibrated on. Where"
                " the test part's error is much larger, they were fitted to more than the driver's"
                " style.",
            ),
            Column(
                "Where calibrated: RMSE of gap (m)",
                partial(_fitted, "rmse_gap"),
                "The same for the gap.",
            ),
        ]
    if any_baselines(jobs, wording.FULL_TRAJECTORY):
        columns += [
            Column(
                "Full trajectory: RMSE of speed (m/s)",
                partial(_metric, "rmse_speed", scope=wording.FULL_TRAJECTORY),
                "The same over the full trajectory of unseen drivers, from its first frame on."
                " Driver-specific calibration does not compete here.",
            ),
            Column(
                "Full trajectory: RMSE of gap (m)",
                partial(_metric, "rmse_gap", scope=wording.FULL_TRAJECTORY),
                "The same for the gap.",
            ),
        ]
    if any("past/bound/policy" in job.metrics for job in jobs):
        columns.append(
            Column(
                "Expected of 90 % of drivers (m/s)",
                lambda row: number(
                    row.job.metrics.get(f"past/bound/{row.method}", math.nan), ".3f"
                ),
                "What the RMSE of speed is expected to stay below for nine drivers in ten: the"
                " error in their past times the factor by which that of drivers left out of"
                " training grew. Where the policy's is larger than driver-specific parameters',"
                " train on recordings of such drivers.",
            )
        )
    return Sheet.of(columns, rows)


def _metric(name: str, row: _Tested, form: str = ".3f", scope: str = wording.TEST) -> Cell:
    return number(row.job.metric(name, row.method, scope), form)


def _fitted(name: str, row: _Tested) -> Cell:
    """Returns a method's mean error where it was calibrated."""
    fits = row.job.tables.get("fits")
    if fits is None or f"train_{name}" not in fits:
        return number(math.nan, ".3f")
    return number(float(fits.loc[fits["method"] == row.method, f"train_{name}"].mean()), ".3f")


class _Compared(NamedTuple):
    job: str
    baseline: str
    scope: str
    improvement: Improvement


def improvements(jobs: Sequence[Result]) -> Sheet:
    """Returns the policy's improvement: a row per job, baseline and part of the trajectories."""
    full = bool(any_baselines(jobs, wording.FULL_TRAJECTORY))
    scopes = (wording.TEST, wording.FULL_TRAJECTORY) if full else (wording.TEST,)
    baselines: list[str] = []
    for scope in scopes:
        baselines += any_baselines(jobs, scope)
    rows = []
    for scope in scopes:
        for baseline in dict.fromkeys(baselines):
            for job in jobs:
                if baseline in job.baselines(scope):
                    improvement = job.statistics(baseline, scope)
                    rows.append(_Compared(job.name, baseline, scope, improvement))
    columns: list[Column[_Compared]] = [
        Column("Job", lambda row: row.job),
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
    return Sheet.of([*columns, *STATISTICS], rows)


def _frames(row: _Compared) -> str:
    said = "test part" if row.scope == wording.TEST else "full trajectory"
    return said.replace(" ", "\N{NO-BREAK SPACE}")


def _p_value(row: Any) -> Cell:
    value = row.improvement.p_value
    cell = number(value, ".2g")
    return replace(cell, text="< 0.0001") if value < 1e-4 else cell


STATISTICS: tuple[Column[Any], ...] = (
    Column(
        "Improvement",
        lambda row: number(row.improvement.geometric, "+.1%"),
        f"1 {wording.MINUS} the geometric mean over drivers of RMSE of the policy / RMSE of the"
        " baseline, RMSE of the speed over these frames. Above 0 the policy is closer to the real"
        " driver.",
    ),
    Column(
        "95 % interval",
        lambda row: interval(row.improvement.ci95_low, row.improvement.ci95_high),
        "Student's t interval of the drivers' logarithms of that ratio.",
    ),
    Column(
        "Of the mean errors",
        lambda row: number(row.improvement.ratio_of_means, "+.1%"),
        f"1 {wording.MINUS} mean RMSE of the policy / mean RMSE of the baseline: pairs with large"
        " errors weigh most.",
    ),
    Column(
        "Median",
        lambda row: number(row.improvement.median, "+.1%"),
        "Half of the drivers improve more.",
    ),
    Column(
        "Better for",
        lambda row: number(row.improvement.win_rate, ".0%"),
        "Share of the pairs with an improvement above 0.",
    ),
    Column(
        "p",
        _p_value,
        "Two-sided t test of the drivers' logarithms of the ratio: below 0.05 where the interval"
        " excludes 0.",
    ),
    Column(
        "Pairs",
        lambda row: number(row.improvement.pairs, "d"),
        "Pairs that count. One does not if a method has no error or a simulation diverges.",
    ),
    Column(
        "Drivers",
        lambda row: number(row.improvement.drivers, "d"),
        "Drivers of these pairs.",
    ),
)
"""Columns of rows that have an `improvement`."""


class SafetySection(Section):
    """Safety and string stability of every method."""

    title = "Safety and string stability"
    entry = "Safety"
    order = 500
    figures = ("platoon",)
    template = """
{% if safety.rows %}
{% call fold("Every method of every job") %}
<p>Slowing down of the last follower divided by that of the leader, and by that of the first
follower; shares of the networks whose platoons are string stable, and had settled before the leader
braked. Hard braking counts frames below \N{MINUS SIGN}8 m/s². At limits: share of frames at a limit
of acceleration, where the guard steps in.
{% if adapts %}Outside: share of frames outside what the policy has learned from.{% endif %}</p>
{{ table(safety, compact=true) }}
{% endcall %}
{% else %}
<p>An older version of cfx wrote these jobs: they have no measure of it but the collisions.</p>
{% endif %}
{% for job in runs.jobs %}
{% for scope, words in job.outside.items() %}
<p>{{ job.name }}, {{ job.scope_label(scope) }}: {{ words }}.</p>
{% endfor %}
{% endfor %}
{% set platoons = drawn_folds("platoon", runs.jobs) | trim %}
{% if platoons %}
<h3>Ten followers in a row</h3>
<p>{{ caption("platoon") }}</p>
{{ platoons }}
{% endif %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return a table of all methods."""
        adapts = not are_calibrations(runs.jobs)
        return {"safety": safety_of_methods(runs.jobs), "adapts": adapts}


class _Driven(NamedTuple):
    job: Result
    method: str


_SAFETY = (
    ("Collisions", "collisions", ".0f"),
    ("Hard braking", "hard_braking", ".0f"),
    ("Jerk (m/s³)", "jerk", ".2f"),
    ("At bounds", "at_bounds", ".1%"),
    ("At limits", "at_limits", ".1%"),
    ("Outside", OUTSIDE, ".1%"),
    ("last / leader", "platoon/head_to_tail", ".2f"),
    ("last / first", "platoon/amplification", ".2f"),
    ("Stable", "platoon/string_stable", ".0%"),
    ("Settled", "platoon/settled", ".0%"),
    ("Least gap (m)", "platoon/min_gap", ".1f"),
    ("Collisions", "platoon/collisions", ".0f"),
    ("Hard braking", "platoon/hard_braking", ".0f"),
)
"""Heading, metric and format."""


def safety_of_methods(jobs: Sequence[Result]) -> Sheet:
    """Returns a row per job and method, with the recorded drivers for comparison."""
    columns: list[Column[_Driven]] = [
        Column("Job", lambda row: row.job.name),
        Column(
            "Driven by",
            lambda row: method_cell(row.method),
            "The method; real: the recorded drivers.",
        ),
    ]
    for heading, metric, form in _SAFETY:
        if metric == OUTSIDE and are_calibrations(jobs):
            continue
        recorded = "Behind recorded leaders, test part"
        group = "Platoon" if metric.startswith("platoon/") else recorded
        cell = partial(_measure, metric=metric, form=form)
        columns.append(Column(heading, cell, group=group))
    rows = []
    for job in jobs:
        for method in ("real", *job.shown_methods):
            if any(math.isfinite(job.metric(metric, method)) for _, metric, _ in _SAFETY):
                rows.append(_Driven(job, method))
    return Sheet.of(columns, rows)


def _measure(row: _Driven, metric: str, form: str) -> Cell:
    return number(row.job.metric(metric, row.method), form)


class MetricsSection(Section):
    """All metrics of all methods, whoever brought them: what the files of a job say of them."""

    title = "All metrics"
    entry = "All metrics"
    order = 600
    template = """
<p>Every metric that a job measured, those of plugins too: one number for each method, which is the
mean, the sum, the least or the largest value over the pairs. Every method starts from the same
measured state and covers the same frames.</p>
{% for job, sheet in measured %}
{% call fold(job.name, loop.first, "job") %}
{{ table(sheet, compact=true) }}
{% for left_out in job.data.get("metrics_left_out") or () %}
<p class="lacking">
{{ left_out.name }} of {{ left_out.distribution }} could not be measured: {{ left_out.reason }}
</p>
{% endfor %}
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return a table for each job."""
        return {"measured": [(job, all_metrics(job)) for job in runs.jobs]}


class _Measured(NamedTuple):
    metric: MetricInfo
    scope: str


def all_metrics(job: Result) -> Sheet:
    """Returns a row for each metric and part of the trajectories, a column for each method."""
    methods = list(job.shown_methods)
    if any(key.endswith("/real") for key in job.metrics):
        methods.insert(0, "real")
    columns: list[Column[_Measured]] = [
        Column("Metric", lambda row: metric_title(row.metric)),
        Column("Frames", lambda row: job.scope_label(row.scope)),
        Column("Over pairs", lambda row: row.metric.summary),
        Column("Better", lambda row: row.metric.direction.replace("none", "")),
    ]
    for method in methods:
        cell = partial(_value, job, method)
        columns.append(Column(wording.short_label(method), cell, wording.explained(method)))
    columns.append(Column("Meaning", _meaning))
    rows = []
    for metric in job.known_metrics:
        rows += [_Measured(metric, scope) for scope in metric.scopes]
    return Sheet.of(columns, rows)


def _meaning(row: _Measured) -> str:
    said, distribution = row.metric.meaning, row.metric.distribution
    if distribution and not distribution.startswith("cfx-driving"):
        said += f" (of {distribution})"
    return said


def _value(job: Result, method: str, row: _Measured) -> Cell:
    value = job.metric(row.metric.name, method, row.scope)
    whole = math.isfinite(value) and value == round(value) and abs(value) < 1e6
    return number(value, ".0f" if whole else ".3g")
