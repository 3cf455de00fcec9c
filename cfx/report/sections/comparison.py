"""All jobs side by side: how close each is to the real drivers, and how safely it drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cfx.evaluation.metrics.base import MetricInfo
from cfx.evaluation.result import METHODS, Purpose
from cfx.report.blocks import Block, Figure, Fold, Heading, Table, Text, View
from cfx.report.figure_blocks import view
from cfx.report.figures.jobs import draw_error_dots, error_limit
from cfx.report.figures.words import FULL_TRAJECTORY, STEADY, TEST, explained, percent, short_label
from cfx.report.job import Job, Runs, any_baselines, any_has_metric, of_purpose
from cfx.report.metrics import metric_title
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, job_names, number, tested, text

_RECORDED = "Behind recorded leaders"
_IN_PLATOON = "Platoon behind a braking leader"
_PLATOON = (
    "Ten followers in a row, all driven by the policy, behind a leader that brakes from 15 to"
    " 7 m/s and recovers."
)


class _Measure(NamedTuple):
    """A measure of safety over a part of the trajectories, and the baseline that stands below."""

    metric: str
    scope: str
    baseline: str
    form: str
    heading: str
    meaning: str


_SAFETY = (
    ("collisions", TEST, "fixed", ".0f", "Collisions"),
    ("collisions", FULL_TRAJECTORY, "population", ".0f", "full trajectory"),
    ("hard_braking", TEST, "fixed", ".0f", "Hard braking"),
    ("hard_braking", FULL_TRAJECTORY, "population", ".0f", "full trajectory"),
    ("jerk", TEST, "fixed", ".2f", "Jerk (m/s³)"),
    ("at_bounds", TEST, "fixed", ".0%", "At bounds"),
    ("platoon/head_to_tail", TEST, "population", ".2f", "Amplification"),
    ("platoon/string_stable", TEST, "population", ".0%", "Stable"),
    ("platoon/min_gap", TEST, "population", ".1f", "Least gap (m)"),
    ("platoon/collisions", TEST, "population", ".0f", "Collisions"),
)
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
    ("rmse_speed", TEST),
    ("rmse_gap", TEST),
    ("rmse_speed", STEADY),
    ("rmse_speed", FULL_TRAJECTORY),
    ("rmse_gap", FULL_TRAJECTORY),
)

_GAINS = (
    ("fixed", TEST),
    ("shrunk", TEST),
    ("population", TEST),
    ("population", FULL_TRAJECTORY),
)


class ComparisonSection(Section):
    """All jobs side by side: how close each is to the real drivers, and how safely it drives."""

    title = "Side by side"
    entry = "Side by side"
    order = 200

    def blocks(self, runs: Runs) -> list[Block]:
        """Return the comparison of all jobs."""
        jobs = runs.jobs
        introduction = (
            "Errors in m/s and m compare across driving models and learners; lower is closer to the"
            " real driver."
        )
        if len(jobs) > 1:
            introduction += (
                " The best of a column is bold where all jobs are tested on the same pairs."
            )
        found: list[Block] = [
            Text(introduction),
            Table(closeness(jobs), compact=True, explain=True),
        ]
        unconditional = of_purpose(jobs, Purpose.POLICY)
        if unconditional:
            found.append(
                Text(
                    f"{job_names(unconditional)}: the policy sets the acceleration itself. With"
                    " constant parameters the model follows no leader, so that no calibration is a"
                    " baseline. Its errors are an upper reference for the models that follow.",
                    "note",
                )
            )
        found += [
            absolute(jobs),
            Heading("Is it safe, and smooth?"),
            Text("The numbers are the policy's; the smaller line below is a baseline's."),
            Table(safety(jobs), compact=True, explain=True),
        ]
        further = every_metric(jobs)
        if further is not None:
            words = "The numbers are the policy's; the smaller line: driver-specific calibration."
            table = Table(further, compact=True, explain=True)
            found.append(Fold("Every metric of every job, test part", (Text(words), table)))
        return found


def closeness(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job: the errors of each method, and the policy's improvement."""
    frames = {
        TEST: tested(jobs),
        FULL_TRAJECTORY: "the full trajectory of unseen drivers, from its first frame on",
    }
    columns = [Column("Job", number=False)]
    rows = [[text(job.name)] for job in jobs]
    groups = [("", 1)]
    for scope, title in (
        (TEST, "Test part: RMSE of speed in m/s, below it of gap in m"),
        (FULL_TRAJECTORY, "Full trajectories: the same"),
    ):
        methods = _measured_methods(jobs, scope)
        for method in methods:
            meaning = f"RMSE over {frames[scope]}, with {explained(method)}."
            columns.append(Column(short_label(method), meaning))
            for row, job in zip(rows, jobs, strict=True):
                row.append(_error(job, scope, method))
        if methods:
            groups.append((title, len(methods)))
    gains = 0
    for baseline, scope in _GAINS:
        if baseline not in any_baselines(jobs, scope):
            continue
        gains += 1
        suffix = "" if scope == TEST else ", full"
        meaning = (
            f"Mean improvement of the RMSE of speed over {explained(baseline)}, on"
            f" {frames[scope]}; below it the 95 % interval."
        )
        columns.append(Column(f"over {short_label(baseline)}{suffix}", meaning))
        for row, job in zip(rows, jobs, strict=True):
            row.append(_gain(job, baseline, scope))
    if gains:
        groups.append(("Improvement of the policy", gains))
    _mark_best(rows, jobs, columns)
    return Sheet(tuple(columns), tuple(tuple(row) for row in rows), tuple(groups))


def safety(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job: the policy's measures of safety, and below them a baseline's."""
    kept = []
    for metric, scope, baseline, form, heading in _SAFETY:
        if any(job.has_metric(metric, job.judged, scope) for job in jobs):
            meaning = _MEANINGS[metric] if scope == TEST else "The same over full trajectories."
            kept.append(_Measure(metric, scope, baseline, form, heading, meaning))
    columns = [Column("Job", number=False)]
    for one in kept:
        meaning = f"{one.meaning} Below it the same for {explained(one.baseline)}."
        columns.append(Column(one.heading, meaning))
    rows = []
    for job in jobs:
        cells = [text(job.name)]
        for one in kept:
            cells.append(_with_baseline(job, one.metric, one.scope, one.baseline, one.form))
        rows.append(tuple(cells))
    platoon = len([one for one in kept if one.metric.startswith("platoon/")])
    groups = [("", 1)]
    for title, count in ((_RECORDED, len(kept) - platoon), (_IN_PLATOON, platoon)):
        if count:
            groups.append((title, count))
    return Sheet(tuple(columns), tuple(rows), tuple(groups))


def every_metric(jobs: Sequence[Job]) -> Sheet | None:
    """Returns a row per job with all metrics of the test part; None if no job lists its metrics."""
    known: dict[str, MetricInfo] = {}
    for job in jobs:
        known |= {one.name: one for one in job.known_metrics if TEST in one.scopes}
    if not known:
        return None
    columns = [Column("Job", number=False)]
    for metric in known.values():
        better = "" if metric.direction == "none" else f" The {metric.direction} the better."
        columns.append(
            Column(metric_title(metric), f"{metric.meaning}, {metric.summary} over pairs.{better}")
        )
    rows = []
    for job in jobs:
        cells = [text(job.name)]
        for name in known:
            cells.append(_with_baseline(job, name, TEST, "fixed", ".3g"))
        rows.append(tuple(cells))
    return Sheet(tuple(columns), tuple(rows))


def absolute(jobs: Sequence[Job]) -> Figure:
    """Errors of each method in m/s and m; a view for each error and part of the trajectories."""
    views: dict[str, View] = {}
    for metric, scope in _ERRORS:
        if not any(job.has_metric(metric, job.judged, scope) for job in jobs):
            continue
        signal, unit = ("speed", "m/s") if metric == "rmse_speed" else ("gap", "m")
        values = {}
        for method in METHODS:
            errors = np.array([_shown_error(job, metric, method, scope) for job in jobs])
            if np.isfinite(errors).any():
                values[method] = errors
        names = [job.name for job in jobs]
        what = f"RMSE of {signal}, mean over pairs"
        drawn = draw_error_dots(names, values, unit=unit, what=what)
        note = error_limit(values, unit)[1]
        views[f"{signal}, {jobs[0].scope_label(scope)}"] = view(drawn, note)
    return Figure(views, "Errors of every job and method", chooser="RMSE of")


def _shown_error(job: Job, metric: str, method: str, scope: str) -> float:
    return job.metric(metric, method, scope) if method in job.meaningful_methods else math.nan


def _measured_methods(jobs: Sequence[Job], scope: str) -> list[str]:
    found = []
    for method in METHODS:
        showing = [job for job in jobs if method in job.meaningful_methods]
        if any_has_metric(showing, "rmse_speed", method, scope):
            found.append(method)
    return found


def _error(job: Job, scope: str, method: str) -> Cell:
    shown = method in job.meaningful_methods
    if not (shown and job.has_metric("rmse_speed", method, scope)):
        return number(math.nan, "")
    speed, gap = job.metric("rmse_speed", method, scope), job.metric("rmse_gap", method, scope)
    second = f"{gap:.2f}" if math.isfinite(gap) else ""
    return replace(number(speed, f"{speed:.3f}"), second=second)


def _gain(job: Job, baseline: str, scope: str) -> Cell:
    if baseline not in job.baselines(scope):
        return number(math.nan, "")
    mean = job.improvement("mean", baseline, scope)
    low = job.improvement("ci95_low", baseline, scope)
    high = job.improvement("ci95_high", baseline, scope)
    second = ""
    if math.isfinite(low) and math.isfinite(high):
        digits = 0 if max(abs(low), abs(high)) >= 1 else 1
        ends = (percent(low, digits), percent(high, digits))
        second = " to ".join(end.removesuffix(" %") for end in ends)
    return replace(number(mean, percent(mean, 1)), second=second)


def _with_baseline(job: Job, metric: str, scope: str, baseline: str, form: str) -> Cell:
    """Returns the policy's number, and below it the baseline's."""
    value = job.metric(metric, job.judged, scope)
    cell = number(value, formatted(value, form))
    if not job.has_metric(metric, baseline, scope):
        return cell
    return replace(cell, second=formatted(job.metric(metric, baseline, scope), form))


def _mark_best(rows: list[list[Cell]], jobs: Sequence[Job], columns: Sequence[Column]) -> None:
    """Marks the policy's smallest error and largest improvement, if all are tested on the same."""
    tests = set()
    for job in jobs:
        fingerprint = str(job.data.get("fingerprint"))
        tests.add((fingerprint, frozenset(job.pairs["pair_id"]), job.split))
    if len(rows) < 2 or len(tests) > 1:
        return
    for k, column in enumerate(columns):
        is_error = column.heading == "policy"
        if not is_error and not column.heading.startswith("over "):
            continue
        known = [float(row[k].sort) for row in rows if row[k].sort]
        if known:
            best = min(known) if is_error else max(known)
            for row in rows:
                row[k] = replace(row[k], best=row[k].sort == repr(best))
