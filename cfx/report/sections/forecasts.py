"""Forecasts from many moments: errors against the horizon and against the history that was read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from cfx.evaluation.forecasts import SCOPE, forecast_methods, metric_name
from cfx.evaluation.metrics.base import key_of
from cfx.report.blocks import Block, Group, Heading, Table, Text
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, method_cell, methods_explained, number

_INTRODUCTION = (
    " In the tables, the smaller line below is its 95 % bootstrap interval over drivers. Origins of"
    " one driver overlap, so they are never counted as independent."
)

_LEADERS = {
    "given": "The leader's future is given: the errors are the follower's alone.",
    "constant_speed": "The leader is predicted at constant speed.",
    "constant_acceleration": "The leader is predicted at constant acceleration.",
}


class ForecastsSection(Section):
    """Errors of forecasts from many moments, by horizon and by the history that was read."""

    title = "Forecasts from every moment"
    entry = "Forecasts"
    order = 700

    def blocks(self, runs: Runs) -> list[Block]:
        """Return plots and a table for each job with forecasts."""
        cards: list[Block] = []
        methods: dict[str, None] = {}
        for job in runs.jobs:
            table = job.tables.get("forecasts")
            if table is not None:
                cards.append(Group(tuple(_job_blocks(job, table)), "card"))
                methods |= dict.fromkeys(forecast_methods(table))
        if not cards:
            return []
        return [
            Text(caption("forecasts") + _INTRODUCTION),
            Text(f"Methods: {methods_explained(methods)}"),
            *cards,
        ]


def _job_blocks(job: Job, table: pd.DataFrame) -> list[Block]:
    leader = str(job.setting("protocol.leader"))
    parts = [
        Heading(job.name),
        Text(_LEADERS.get(leader, "")),
        figure_of("forecasts", job),
        Table(errors(job, table, "rmse_speed", "m/s")),
        Table(errors(job, table, "rmse_position", "m")),
        figure_of("forecasts_by_history", job),
    ]
    return [part for part in parts if part is not None]


def errors(job: Job, table: pd.DataFrame, error: str, unit: str) -> Sheet:
    """Returns a row per method and a column per horizon.

    Args:
        job: of the report.
        table: its forecasts.
        error: which.
        unit: of it.
    """
    horizons = _horizons(table)
    of_what = error.removeprefix("rmse_")
    columns = [Column("Method", number=False)]
    for horizon in horizons:
        meaning = f"RMSE of {of_what} {horizon:g} s after the origin, {unit}; mean over drivers."
        columns.append(Column(f"{of_what}, {horizon:g} s ({unit})", meaning))
    rows: list[tuple[Cell, ...]] = []
    for method in forecast_methods(table):
        cells = [method_cell(method)]
        cells += [_cell(job, metric_name(error, horizon), method) for horizon in horizons]
        rows.append(tuple(cells))
    return Sheet(tuple(columns), tuple(rows))


def _cell(job: Job, metric: str, method: str) -> Cell:
    key = key_of(metric, method, SCOPE)
    value = job.metrics.get(key, math.nan)
    low = job.metrics.get(f"{key}/ci95_low", math.nan)
    high = job.metrics.get(f"{key}/ci95_high", math.nan)
    cell = number(value, formatted(value, ".3f"))
    if math.isfinite(low) and math.isfinite(high):
        return replace(cell, second=f"{formatted(low, '.3f')} to {formatted(high, '.3f')}")
    return cell


def _horizons(table: pd.DataFrame) -> Sequence[float]:
    return sorted(float(horizon) for horizon in table["horizon_s"].unique())
