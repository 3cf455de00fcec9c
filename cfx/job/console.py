"""What a job prints when it is done: a table of the methods, then a few sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from cfx.evaluation.result import Evaluation, Improvement
from cfx.job.results import JobResult

if TYPE_CHECKING:
    from cfx.tracking.tracker import Tracker


def report(
    result: JobResult,
    evaluation: Evaluation,
    console: Console,
    tracker: Tracker,
    *,
    has_constant_baseline: bool = True,
) -> None:
    """Prints the table, where the results are and how to open them; `has_constant_baseline` as `DrivingModel.has_constant_baseline`."""
    table = Table(
        title=f"{len(evaluation.drives)} pair{'s' * (len(evaluation.drives) != 1)}, test part in closed loop",
        title_justify="left",
    )
    m = result.metrics
    columns = {"RMSE speed [m/s]": "rmse_speed", "RMSE gap [m]": "rmse_gap"}
    if evaluation.full_trajectory_improvements:
        columns |= {
            "whole speed [m/s]": "full_trajectory/rmse_speed",
            "whole gap [m]": "full_trajectory/rmse_gap",
        }
    table.add_column("method")
    for heading in (*columns, "collisions"):
        table.add_column(heading, justify="right")
    for method in evaluation.methods:
        values = [
            f"{m[f'{key}/{method}']:.3f}" if f"{key}/{method}" in m else ""
            for key in columns.values()
        ]
        table.add_row(method, *values, f"{m[f'collisions/{method}']:.0f}")
    console.print(table)
    if not has_constant_baseline:
        text = "With constant parameters the model follows no leader: compare the policy's RMSE with other jobs'."
        console.print(text, soft_wrap=True)
    else:
        _tell(evaluation.improvement, "fixed", console)
        if "fixed" in evaluation.steady_improvements:
            _tell(evaluation.steady_improvements["fixed"], "fixed beyond the first 5 s", console)
        if "shrunk" in evaluation.improvements:
            _tell(
                evaluation.improvements["shrunk"],
                "shrunk (own, shrunk towards the default)",
                console,
            )
        if "population" in evaluation.improvements:
            _tell(evaluation.improvements["population"], "population", console)
        if "population" in evaluation.full_trajectory_improvements:
            _tell(
                evaluation.full_trajectory_improvements["population"],
                "population on whole drives",
                console,
            )
    _warn(evaluation, m, console)
    console.print(f"Results: {result.folder}", soft_wrap=True, highlight=False)
    for line in tracker.how_to_open():
        console.print(line, soft_wrap=True, highlight=False)


def _tell(i: Improvement, baseline: str, console: Console) -> None:
    known = math.isfinite(i.ci95_low)
    interval = (
        f"95 % interval {i.ci95_low:+.1%} to {i.ci95_high:+.1%}"
        if known
        else "no interval: it needs two drivers"
    )
    console.print(
        f"Improvement of policy over {baseline}, RMSE of speed: mean {i.mean:+.1%} ({interval}), trimmed mean"
        f" {i.trimmed_mean:+.1%}, median {i.median:+.1%}; better for {i.win_rate:.0%} of {i.pairs}"
        f" {'pair' if i.pairs == 1 else 'pairs'}; Wilcoxon p = {i.p_value:.2g}",
        soft_wrap=True,
        highlight=False,
    )
    if i.undefined:
        console.print(
            f"{i.undefined} pairs have no improvement: a drive diverged, or {baseline} drives without any error."
        )


def _warn(evaluation: Evaluation, metrics: Mapping[str, float], console: Console) -> None:
    """Prints a line about what is not safe or not free in what was driven; nothing if there is nothing."""

    def listed(name: str, least: float, form: str) -> str:
        found = {method: metrics.get(f"{name}/{method}", 0.0) for method in evaluation.methods}
        return ", ".join(
            f"{method} {value:{form}}" for method, value in found.items() if value >= least
        )

    braking, stuck = listed("hard_braking", 1, ".0f"), metrics.get("at_bounds/policy", 0.0) >= 0.01
    said = [f"Frames with an acceleration below -8 m/s2: {braking}."] if braking else []
    said += [f"Parameters at their bounds: {listed('at_bounds', 0.01, '.0%')}."] if stuck else []
    if said:
        console.print(" ".join(said), soft_wrap=True, highlight=False)
