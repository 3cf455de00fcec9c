"""All jobs side by side: errors and safety of each, and how much both depend on the seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from cfx.plugin import METHODS, MetricInfo, Purpose, Result, canvas, wording
from cfx_report.figures.jobs import draw_error_dots, error_limit
from cfx_report.jobs import (
    Runs,
    any_baselines,
    any_has_metric,
    are_calibrations,
    judge_of,
    metric_title,
    of_purpose,
)
from cfx_report.names import (
    Row,
    any_adapts,
    baselines_of,
    comparison_of,
    methods_of,
    rows_over_seeds,
)
from cfx_report.section import (
    Cell,
    Column,
    Section,
    Sheet,
    View,
    formatted,
    job_names,
    number,
    tested,
)

_RECORDED = "Behind recorded leaders"
_IN_PLATOON = "Platoon behind a braking leader"
_PLATOON = (
    "Ten followers in a row, all driven by the policy, behind a leader that brakes from 15 to"
    " 7 m/s and recovers."
)

_SAFETY = (
    ("collisions", wording.TEST, "driver_specific", ".0f", "Collisions"),
    ("collisions", wording.FULL_TRAJECTORY, "pooled", ".0f", "full trajectory"),
    ("hard_braking", wording.TEST, "driver_specific", ".0f", "Hard braking"),
    ("hard_braking", wording.FULL_TRAJECTORY, "pooled", ".0f", "full trajectory"),
    ("jerk", wording.TEST, "driver_specific", ".2f", "Jerk (m/s³)"),
    ("at_bounds", wording.TEST, "driver_specific", ".0%", "At bounds"),
    ("platoon/head_to_tail", wording.TEST, "pooled", ".2f", "Amplification"),
    ("platoon/string_stable", wording.TEST, "pooled", ".0%", "Stable"),
    ("platoon/min_gap", wording.TEST, "pooled", ".1f", "Least gap (m)"),
    ("platoon/collisions", wording.TEST, "pooled", ".0f", "Collisions"),
)
"""Measures: metric, part of the trajectories, baseline that stands below, format, heading."""

_MEANINGS = {
    "collisions": "Pairs in which the simulated gap becomes negative, on the test part.",
    "hard_braking": "Frames with an acceleration below \N{MINUS SIGN}8 m/s², test part.",
    "jerk": "Root mean square jerk on the test part, mean over the pairs.",
    "at_bounds": "Share of the tuned parameters' values within 1 % of a bound.",
    "platoon/head_to_tail": f"{_PLATOON} By how many times as much as the leader the last follower"
    " slows down, mean over the networks; above 1 the platoon amplifies.",
    "platoon/string_stable": f"{_PLATOON} Share of the networks with a string stable platoon: no"
    " vehicle slows down more than the vehicle ahead (by over 0.1 m/s).",
    "platoon/min_gap": f"{_PLATOON} The least gap of all.",
    "platoon/collisions": f"{_PLATOON} Followers that collide, of all platoons.",
}

_ERRORS = (
    ("rmse_speed", wording.TEST),
    ("rmse_gap", wording.TEST),
    ("rmse_speed", wording.STEADY),
    ("rmse_speed", wording.FULL_TRAJECTORY),
    ("rmse_gap", wording.FULL_TRAJECTORY),
)

_GAINS = (
    ("driver_specific", wording.TEST),
    ("shrunk", wording.TEST),
    ("pooled", wording.TEST),
    ("pooled", wording.FULL_TRAJECTORY),
)

_JOB = Column[Result]("Job", lambda job: job.name)

_RANKED = (
    "Jobs are sorted by the error of the method that each is judged by (the policy; of a"
    " calibration driver-specific parameters), the smallest first, which is bold. Jobs that were"
    " tested on other pairs or frames do not compare and come last."
)


class ComparisonSection(Section):
    """All jobs side by side: how close each is to the real drivers, and how safely it drives."""

    title = "Side by side"
    entry = "Side by side"
    order = 200
    template = """
<p>Errors in m/s and m compare across driving models{{ " and learners" if adapts }}; lower is closer
to the real driver.
</p>
{% if runs.jobs | length > 1 %}
<p>{{ ranked }}</p>
{% endif %}
{{ table(closeness, compact=true, explain=true) }}
{% if unconditional %}
<p class="note">{{ unconditional }}: the policy sets the acceleration itself. With constant
parameters the model follows no leader, so that no calibration is a baseline. Its errors are an
upper reference for the models that follow.</p>
{% endif %}
{{ figure(errors, "Errors of every job and method", "RMSE of") }}
<h3>Is it safe, and smooth?</h3>
<p>{{ numbers }}{{ "; the smaller line below is a baseline's" if adapts }}.</p>
{{ table(safety, compact=true, explain=true) }}
{% if every_metric %}
{% call fold("Every metric of every job, test part") %}
<p>{{ numbers }}{{ "; the smaller line: driver-specific calibration" if adapts }}.</p>
{{ table(every_metric, compact=true, explain=true) }}
{% endcall %}
{% endif %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the comparison of all jobs."""
        jobs = runs.jobs
        adapts = not are_calibrations(jobs)
        whose = "the policy's" if adapts else "those of driver-specific calibration"
        return {
            "adapts": adapts,
            "numbers": f"The numbers are {whose}",
            "ranked": _RANKED,
            "closeness": closeness(jobs),
            "unconditional": job_names(of_purpose(jobs, Purpose.POLICY)),
            "errors": absolute(jobs),
            "safety": safety(jobs),
            "every_metric": every_metric(jobs),
        }


def closeness(jobs: Sequence[Result]) -> Sheet:
    """Returns a row per job: the errors of each method, and the policy's improvement."""
    frames = {
        wording.TEST: tested(jobs),
        wording.FULL_TRAJECTORY: "the full trajectory of unseen drivers, from its first frame on",
    }
    judge = judge_of(jobs)
    other = "rmse_gap" if judge.name == "rmse_speed" else "rmse_speed"
    below = "the RMSE of the gap in m" if other == "rmse_gap" else "the RMSE of speed in m/s"
    ranking = comparison_of(jobs).ranking
    jobs, columns = _by_error(jobs, ranking.jobs), [_JOB]
    for scope, group in (
        (wording.TEST, f"Test part: {metric_title(judge)}, below it {below}"),
        (wording.FULL_TRAJECTORY, "Full trajectories: the same"),
    ):
        for method in METHODS:
            showing = [job for job in jobs if method in job.shown_methods]
            if any_has_metric(showing, judge.name, method, scope):
                meaning = f"Error over {frames[scope]}, with {wording.explained(method)}."
                cell = partial(_error, metrics=(judge.name, other), scope=scope, method=method)
                columns.append(Column(wording.short_label(method), cell, meaning, group))
    for baseline, scope in _GAINS:
        if baseline in any_baselines(jobs, scope):
            suffix = "" if scope == wording.TEST else ", full"
            meaning = (
                f"Improvement over {wording.explained(baseline)}, on {frames[scope]}, geometric"
                " over drivers; below it the 95 % interval."
            )
            heading = f"over {wording.short_label(baseline)}{suffix}"
            cell = partial(_gain, baseline=baseline, scope=scope)
            columns.append(Column(heading, cell, meaning, "Improvement of the policy"))
    sheet = Sheet.of(columns, jobs)
    return _with_best(sheet, jobs[0].judged) if ranking.against else sheet


def _by_error(jobs: Sequence[Result], ranked: Sequence[str]) -> list[Result]:
    """Returns the jobs that were tested on the same frames, the smallest error first; then others.

    The error is that of the method that a job is judged by, the mean over seeds.

    Args:
        jobs: in any order.
        ranked: names of their rows over seeds, the smallest error first.
    """
    places: dict[str, int] = {}
    for row in rows_over_seeds(jobs):
        for job in row.jobs:
            places[job.name] = ranked.index(row.name) if row.name in ranked else len(ranked)
    return sorted(jobs, key=lambda job: places[job.name])


def safety(jobs: Sequence[Result]) -> Sheet:
    """Returns a row per job: the policy's measures of safety, and below them a baseline's."""
    columns = [_JOB]
    for metric, scope, baseline, form, heading in _SAFETY:
        if any(job.has_metric(metric, job.judged, scope) for job in jobs):
            meaning = (
                _MEANINGS[metric] if scope == wording.TEST else "The same over full trajectories."
            )
            if not are_calibrations(jobs):
                meaning += f" Below it the same for {wording.explained(baseline)}."
            group = _IN_PLATOON if metric.startswith("platoon/") else _RECORDED
            cell = partial(_with_baseline, metric=metric, scope=scope, baseline=baseline, form=form)
            columns.append(Column(heading, cell, meaning, group))
    return Sheet.of(columns, jobs)


def every_metric(jobs: Sequence[Result]) -> Sheet | None:
    """Returns a row per job with all metrics of the test part; None if no job lists its metrics."""
    metrics: dict[str, MetricInfo] = {}
    for job in jobs:
        for metric in job.known_metrics:
            if wording.TEST in metric.scopes:
                metrics[metric.name] = metric
    columns = [_JOB]
    for metric in metrics.values():
        better = "" if metric.direction == "none" else f" The {metric.direction} the better."
        meaning = f"{metric.meaning}, {metric.summary} over pairs.{better}"
        cell = partial(
            _with_baseline,
            metric=metric.name,
            scope=wording.TEST,
            baseline="driver_specific",
            form=".3g",
        )
        columns.append(Column(metric_title(metric), cell, meaning))
    return Sheet.of(columns, jobs) if metrics else None


def absolute(jobs: Sequence[Result]) -> dict[str, View]:
    """Errors of each method in m/s and m; a view for each error and part of the trajectories."""
    views = {}
    for metric, scope in _ERRORS:
        if not any(job.has_metric(metric, job.judged, scope) for job in jobs):
            continue
        signal, unit = ("speed", "m/s") if metric == "rmse_speed" else ("the gap", "m")
        values = {}
        for method in METHODS:
            errors = np.array([_shown_error(job, metric, method, scope) for job in jobs])
            if np.isfinite(errors).any():
                values[method] = errors
        names = [job.name for job in jobs]
        what = f"RMSE of {signal}, mean over pairs"
        drawn = draw_error_dots(names, values, unit=unit, what=what)
        note = error_limit(values, unit)[1]
        views[f"{signal}, {jobs[0].scope_label(scope)}"] = View(drawn, note)
    return views


def _shown_error(job: Result, metric: str, method: str, scope: str) -> float:
    return job.metric(metric, method, scope) if method in job.shown_methods else math.nan


def _error(job: Result, metrics: tuple[str, str], scope: str, method: str) -> Cell:
    """Returns an error of a method, and below it another one."""
    first, other = metrics
    if not (method in job.shown_methods and job.has_metric(first, method, scope)):
        return number(math.nan, "")
    beside = job.metric(other, method, scope)
    second = formatted(beside, ".2f") if math.isfinite(beside) else ""
    return number(job.metric(first, method, scope), ".3f", second)


def _gain(job: Result, baseline: str, scope: str) -> Cell:
    if baseline not in job.baselines(scope):
        return number(math.nan, "")
    low = job.statistics(baseline, scope).ci95_low
    high = job.statistics(baseline, scope).ci95_high
    second = ""
    if math.isfinite(low) and math.isfinite(high):
        digits = 0 if max(abs(low), abs(high)) >= 1 else 1
        ends = (wording.percent(low, digits), wording.percent(high, digits))
        second = " to ".join(end.removesuffix(" %") for end in ends)
    return number(job.statistics(baseline, scope).geometric, "+.1%", second)


def _with_baseline(job: Result, metric: str, scope: str, baseline: str, form: str) -> Cell:
    """Returns the policy's number, and below it the baseline's."""
    second = ""
    if baseline != job.judged and job.has_metric(metric, baseline, scope):
        second = formatted(job.metric(metric, baseline, scope), form)
    return number(job.metric(metric, job.judged, scope), form, second)


def _with_best(sheet: Sheet, method: str) -> Sheet:
    """Marks the first job's error of the method that it is judged by, which is the smallest."""
    best = wording.short_label(method)
    cells = list(sheet.rows[0])
    for place, column in enumerate(sheet.columns):
        if column.heading == best:  # of the test part, which stands before full trajectories
            cells[place] = replace(cells[place], best=True)
            break
    return replace(sheet, rows=(tuple(cells), *sheet.rows[1:]))


class SeedsSection(Section):
    """How much results depend on the seed: jobs that differ in it alone, in one row."""

    title = "Over seeds"
    entry = "Over seeds"
    order = 100
    template = """
<p>Jobs that differ in the seed alone share a row: their mean, and below it the least and the
largest of them. The seed decides how drivers are divided into folds, what optimizers draw, and how
networks begin. A difference between rows that is no larger than these ranges says nothing. Whether
it holds for other drivers, the intervals of each job say.</p>
{{ table(rows, compact=true, explain=true) }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the jobs over their seeds; nothing where no two differ in it alone."""
        rows = rows_over_seeds(runs.jobs)
        return None if len(rows) == len(runs.jobs) else {"rows": over_seeds(rows)}


def over_seeds(rows: Sequence[Row]) -> Sheet:
    """Returns a row per group of jobs: errors of each method, and the policy's improvement."""
    where = tested(chain.from_iterable(row.jobs for row in rows))
    columns: list[Column[Row]] = [
        Column(
            "Jobs", lambda row: row.name, "Named by what differs between them, without the seed."
        ),
        Column("Seeds", lambda row: number(len(row.jobs), "d"), "Jobs of the row."),
    ]
    judge = judge_of(chain.from_iterable(row.jobs for row in rows))
    errors = f"Test part: {metric_title(judge)}"
    for method in methods_of(rows):
        meaning = f"{judge.heading} over {where}, with {wording.explained(method)}."
        cell = partial(_error_over_seeds, metric=judge.name, method=method)
        columns.append(Column(wording.short_label(method), cell, meaning, errors))
    for baseline in baselines_of(rows):
        meaning = f"Improvement over {wording.explained(baseline)}, test part, geometric."
        heading, cell = (
            f"over {wording.short_label(baseline)}",
            partial(_gain_over_seeds, baseline=baseline),
        )
        columns.append(Column(heading, cell, meaning, "Improvement of the policy"))
    return Sheet.of(columns, rows)


def _error_over_seeds(row: Row, metric: str, method: str) -> Cell:
    """Returns a method's mean error and its range; empty where its jobs have no such method."""
    if method == "policy" and not any_adapts([row]):
        return number(np.nan, "")
    return _mean_and_range(row.values(metric, method), ".3f")


def _gain_over_seeds(row: Row, baseline: str) -> Cell:
    return _mean_and_range(row.improvements("geometric", baseline), "+.1%")


def _mean_and_range(values: np.ndarray, form: str) -> Cell:
    """Returns the mean, and below it the least and the largest value, where they differ."""
    measured = canvas.finite(values)
    if not len(measured):
        return number(np.nan, form)
    ends = []
    for end in (measured.min(), measured.max()):
        ends.append(formatted(float(end), form).removesuffix(" %"))
    second = " to ".join(ends) if len(set(ends)) > 1 else ""
    return number(float(measured.mean()), form, second)
