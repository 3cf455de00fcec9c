"""Forecasts from many moments: their errors, and the scores of samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import pandas as pd

from cfx.plugin import Result, key_of
from cfx_forecasts.distributions import centre_errors, sampled_methods, summarize_distributions
from cfx_forecasts.errors import SCOPE, forecast_methods, metric_name
from cfx_forecasts.figures import sampled_name
from cfx_report.jobs import Runs
from cfx_report.section import (
    Cell,
    Column,
    Section,
    Sheet,
    formatted,
    method_cell,
    methods_explained,
    number,
)

_LEADERS = {
    "given": "The leader's future is given: the errors are the follower's alone.",
    "constant_speed": "The leader is predicted at constant speed.",
    "constant_acceleration": "The leader is predicted at constant acceleration.",
}

_METHOD = Column[str]("Method", method_cell)


class ForecastsSection(Section):
    """Errors of forecasts from many moments, by horizon and by the history that was read."""

    title = "Forecasts from every moment"
    entry = "Forecasts"
    order = 700
    figures = ("forecasts", "forecasts_by_history")
    template = """
<p>{{ caption("forecasts") }} In the tables, the smaller line below is its 95 % interval
over drivers. Origins of one driver overlap, so they are never counted as independent.</p>
<p>Methods: {{ methods }}</p>
{% for block in forecasts %}
<div class="card">
<h3>{{ block.job.name }}</h3>
<p>{{ block.leader }}</p>
{{ drawn("forecasts", block.job) }}
{{ table(block.speed) }}
{{ table(block.position) }}
{{ drawn("forecasts_by_history", block.job) }}
</div>
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return tables for each job with forecasts."""
        blocks = []
        methods: list[str] = []
        for job in runs.jobs:
            table = job.tables.get("forecasts")
            if table is not None:
                leader = _LEADERS.get(str(job.setting("protocol.leader")), "")
                speed = errors(job, table, "rmse_speed", "m/s")
                position = errors(job, table, "rmse_position", "m")
                blocks.append({"job": job, "leader": leader, "speed": speed, "position": position})
                methods += forecast_methods(table)
        return {"forecasts": blocks, "methods": methods_explained(methods)} if blocks else None


def errors(job: Result, table: pd.DataFrame, error: str, unit: str) -> Sheet:
    """Returns a row per method and a column per horizon.

    Args:
        job: of the report.
        table: its forecasts.
        error: which.
        unit: of it.
    """
    of_what = error.removeprefix("rmse_")
    columns = [_METHOD]
    for horizon in _horizons(table):
        meaning = f"RMSE of {of_what} {horizon:g} s after the origin, {unit}; mean over drivers."
        cell = partial(_error, job, metric_name(error, horizon))
        columns.append(Column(f"{of_what}, {horizon:g} s ({unit})", cell, meaning))
    return Sheet.of(columns, forecast_methods(table))


def _error(job: Result, metric: str, method: str) -> Cell:
    key = key_of(metric, method, SCOPE)
    low = job.metrics.get(f"{key}/ci95_low", math.nan)
    high = job.metrics.get(f"{key}/ci95_high", math.nan)
    second = ""
    if math.isfinite(low) and math.isfinite(high):
        second = f"{formatted(low, '.3f')} to {formatted(high, '.3f')}"
    return number(job.metrics.get(key, math.nan), ".3f", second)


def _horizons(table: pd.DataFrame) -> list[float]:
    return sorted(float(horizon) for horizon in table["horizon_s"].unique())


class DistributionsSection(Section):
    """Sampled forecasts: proper scores, coverage, PIT."""

    title = "Sampled forecasts"
    entry = "Distributions"
    order = 800
    figures = ("distributions",)
    template = """
<p>From every moment of the test trajectories several paths were sampled. The CRPS of a single path
is its absolute error, so the policy's centre, where nothing is drawn, can stand beside it.
{{ caption("distributions") }}</p>
<p>Methods: {{ methods }}</p>
{% for job, sheet in sampled %}
{% call fold(job.name, loop.first, "job") %}
{{ drawn("distributions", job) }}
{{ table(sheet) }}
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return a table for each job with sampled forecasts."""
        blocks = []
        methods: list[str] = []
        for job in runs.jobs:
            if {"distributions", "forecasts"} <= set(job.tables):
                sheet = crps_sheet(job.tables["distributions"], job.tables["forecasts"])
                blocks.append((job, sheet))
                methods += _names(job.tables["distributions"])
        return {"sampled": blocks, "methods": methods_explained(methods)} if blocks else None


def crps_sheet(table: pd.DataFrame, forecasts: pd.DataFrame) -> Sheet:
    """Returns a row per sampled method and one for the policy's centre, a column per horizon.

    Args:
        table: scores, as a job has written them.
        forecasts: of the same job.
    """
    summary = summarize_distributions(table)
    summary["method"] = summary["method"].astype(str).map(sampled_name)
    centre = centre_errors(forecasts).assign(method="policy", coverage=math.nan)
    scores = pd.concat([summary, centre]).set_index(["method", "horizon_s"])
    columns = [_METHOD]
    for horizon in _horizons(table):
        meaning = f"CRPS of speed {horizon:g} s after the origin, m/s; below it the coverage."
        cell = partial(_score, scores, horizon)
        columns.append(Column(f"CRPS, {horizon:g} s (m/s)", cell, meaning))
    return Sheet.of(columns, _names(table))


def _score(scores: pd.DataFrame, horizon: float, method: str) -> Cell:
    crps = float(scores["crps_speed"].get((method, horizon), math.nan))
    if method == "policy":
        return number(crps, ".3f")
    coverage = float(scores["coverage"].get((method, horizon), math.nan))
    return number(crps, ".3f", formatted(coverage, ".0%"))


def _names(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns what the methods are called beside the policy's centre, which stands last."""
    return (*(sampled_name(method) for method in sampled_methods(table)), "policy")
