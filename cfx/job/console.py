"""What a job prints when it is done: a table of the methods, then a few sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cfx.evaluation.result import Evaluation, Improvement
from cfx.job.results import JobResult
from cfx.metrics.base import MetricInfo, key_of

if TYPE_CHECKING:
    from cfx.tracking.tracker import Tracker

_SCOPES = {"test": "test part", "full_trajectory": "full trajectories"}
"""The scopes that have a table of their own, in words."""


def report(
    result: JobResult,
    evaluation: Evaluation,
    console: Console,
    tracker: Tracker,
    *,
    has_constant_baseline: bool = True,
) -> None:
    """Prints the table, where the results are and how to open them.

    Args:
        result: of the job.
        evaluation: what was measured.
        console: where it is printed.
        tracker: says how to open the job's run.
        has_constant_baseline: as `DrivingModel.has_constant_baseline`.
    """
    console.print(methods_table(evaluation, result.metrics))
    if evaluation.full_trajectory_improvements:
        console.print(methods_table(evaluation, result.metrics, "full_trajectory"))
    if has_constant_baseline:
        _print_improvements(evaluation, console)
    else:
        text = (
            "With constant parameters the model follows no leader: compare the policy's RMSE"
            " with other jobs'."
        )
        console.print(text, soft_wrap=True)
    _print_safety(evaluation, result.metrics, console)
    for scope, words in evaluation.outside.items():
        text = f"Policy, {_SCOPES[scope]}: {words}; there it fades towards its base parameters."
        console.print(text, soft_wrap=True, highlight=False)
    for one in evaluation.left_out:
        text = f"Not measured: {one.name} of the distribution {one.distribution} ({one.reason})."
        console.print(text, soft_wrap=True, highlight=False)
    console.print(f"Results: {result.folder}", soft_wrap=True, highlight=False)
    for line in tracker.how_to_open():
        console.print(line, soft_wrap=True, highlight=False)


def methods_table(
    evaluation: Evaluation, metrics: Mapping[str, float], scope: str = "test"
) -> Table:
    """Returns the metrics of one scope that are headlines: a row per method that has any."""
    count = len(evaluation.trajectories)
    plural = "" if count == 1 else "s"
    title = f"{count} pair{plural}, {_SCOPES[scope]} in closed loop"
    table = Table(title=title, title_justify="left")
    table.add_column("method")
    shown = [one for one in evaluation.measured if one.headline and scope in one.scopes]
    for metric in shown:
        table.add_column(escape(metric.title), justify="right")
    for method in evaluation.methods:
        values = [metrics.get(key_of(metric.name, method, scope)) for metric in shown]
        if all(value is None for value in values):
            continue
        cells = []
        for metric, value in zip(shown, values, strict=True):
            cells.append(_cell(metric, value))
        table.add_row(method, *cells)
    return table


def _cell(metric: MetricInfo, value: float | None) -> str:
    """Returns a number as the table shows it: sums of whole numbers without decimals."""
    if value is None:
        return ""
    if not math.isfinite(value):
        return "not defined"
    if metric.summary == "sum" and value == round(value):
        return f"{value:.0f}"
    return f"{value:.3f}"


def _print_improvements(evaluation: Evaluation, console: Console) -> None:
    """Prints a sentence for each comparison of the policy with a baseline."""
    test, full = evaluation.improvements, evaluation.full_trajectory_improvements
    sentences = [
        (test, "fixed", "fixed"),
        (evaluation.steady_improvements, "fixed", "fixed after the transient"),
        (test, "shrunk", "shrunk (the driver's own, shrunk towards the default)"),
        (test, "population", "population"),
        (full, "population", "population on full trajectories"),
    ]
    for improvements, baseline, words in sentences:
        if baseline in improvements:
            _print_improvement(improvements[baseline], words, console)


def _print_improvement(i: Improvement, baseline: str, console: Console) -> None:
    if i.pairs == 0:
        console.print(
            f"Improvement of policy over {baseline}, RMSE of speed: not defined for any of"
            f" {i.undefined} pairs: a simulation diverged, or {baseline} has no error at all.",
            soft_wrap=True,
            highlight=False,
        )
        return
    interval = "no interval: it needs two drivers"
    if math.isfinite(i.ci95_low):
        interval = f"95 % interval {i.ci95_low:+.1%} to {i.ci95_high:+.1%}"
    pairs = "1 pair" if i.pairs == 1 else f"{i.pairs} pairs"
    console.print(
        f"Improvement of policy over {baseline}, RMSE of speed: mean {i.mean:+.1%} ({interval}),"
        f" trimmed mean {i.trimmed_mean:+.1%}, median {i.median:+.1%};"
        f" better for {i.win_rate:.0%} of {pairs}; Wilcoxon p = {i.p_value:.2g}",
        soft_wrap=True,
        highlight=False,
    )
    if i.undefined:
        console.print(
            f"{i.undefined} pairs have no improvement: a simulation diverged,"
            f" or {baseline} has no error at all.",
            soft_wrap=True,
            highlight=False,
        )


def _print_safety(evaluation: Evaluation, metrics: Mapping[str, float], console: Console) -> None:
    """Prints a line about hard braking and parameters at their bounds, if there are any."""
    sentences = []
    braking = _methods_above(evaluation, metrics, "hard_braking", 1, ".0f")
    if braking:
        sentences.append(f"Frames with an acceleration below -8 m/s2: {braking}.")
    if metrics.get("at_bounds/policy", 0.0) >= 0.01:
        at_bounds = _methods_above(evaluation, metrics, "at_bounds", 0.01, ".0%")
        sentences.append(f"Parameters at their bounds: {at_bounds}.")
    if sentences:
        console.print(" ".join(sentences), soft_wrap=True, highlight=False)


def _methods_above(
    evaluation: Evaluation, metrics: Mapping[str, float], name: str, least: float, form: str
) -> str:
    """Lists the methods whose metric is at least so much, with its value."""
    found = []
    for method in evaluation.methods:
        value = metrics.get(key_of(name, method), 0.0)
        if value >= least:
            found.append(f"{method} {value:{form}}")
    return ", ".join(found)
