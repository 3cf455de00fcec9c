"""Metrics of all methods: those of safety and string stability, and every one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from cfx.evaluation.metrics.base import MetricInfo
from cfx.report.figures.text import explained, short_label
from cfx.report.job import Job, Runs
from cfx.report.metrics import metric_title
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, method_cell, number


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
of acceleration, where the guard steps in. Outside: share of frames outside what the policy has
learned from.</p>
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
        return {"safety": safety_of_methods(runs.jobs)}


class _Driven(NamedTuple):
    job: Job
    method: str


_SAFETY = (
    ("Collisions", "collisions", ".0f"),
    ("Hard braking", "hard_braking", ".0f"),
    ("Jerk (m/s³)", "jerk", ".2f"),
    ("At bounds", "at_bounds", ".1%"),
    ("At limits", "at_limits", ".1%"),
    ("Outside", "outside_range", ".1%"),
    ("last / leader", "platoon/head_to_tail", ".2f"),
    ("last / first", "platoon/amplification", ".2f"),
    ("Stable", "platoon/string_stable", ".0%"),
    ("Settled", "platoon/settled", ".0%"),
    ("Least gap (m)", "platoon/min_gap", ".1f"),
    ("Collisions", "platoon/collisions", ".0f"),
    ("Hard braking", "platoon/hard_braking", ".0f"),
)
"""Heading, metric and format."""


def safety_of_methods(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job and method, with the recorded drivers for comparison."""
    columns = [
        Column[_Driven]("Job", lambda row: row.job.name),
        Column(
            "Driven by",
            lambda row: method_cell(row.method),
            "The method; real: the recorded drivers.",
        ),
    ]
    for heading, metric, form in _SAFETY:
        recorded = "Behind recorded leaders, test part"
        group = "Platoon" if metric.startswith("platoon/") else recorded
        cell = partial(_measure, metric=metric, form=form)
        columns.append(Column(heading, cell, group=group))
    rows = []
    for job in jobs:
        for method in ("real", *job.meaningful_methods):
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
{% for one in job.data.get("metrics_left_out") or () %}
<p class="lacking">
{{ one.name }} of {{ one.distribution }} could not be measured: {{ one.reason }}
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


def all_metrics(job: Job) -> Sheet:
    """Returns a row for each metric and part of the trajectories, a column for each method."""
    methods = list(job.meaningful_methods)
    if any(key.endswith("/real") for key in job.metrics):
        methods.insert(0, "real")
    columns = [
        Column[_Measured]("Metric", lambda row: metric_title(row.metric)),
        Column("Frames", lambda row: job.scope_label(row.scope)),
        Column("Over pairs", lambda row: row.metric.summary),
        Column("Better", lambda row: row.metric.direction.replace("none", "")),
    ]
    for method in methods:
        cell = partial(_value, job, method)
        columns.append(Column(short_label(method), cell, explained(method)))
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


def _value(job: Job, method: str, row: _Measured) -> Cell:
    value = job.metric(row.metric.name, method, row.scope)
    whole = math.isfinite(value) and value == round(value) and abs(value) < 1e6
    return number(value, ".0f" if whole else ".3g")
