"""Sampled forecasts: proper scores, coverage, PIT."""

from __future__ import annotations

import math
from dataclasses import replace

import pandas as pd

from cfx.evaluation.distributions import (
    centre_errors,
    sampled_methods,
    summarize_distributions,
)
from cfx.report.blocks import Block, Table, Text, job_folds
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.figures.forecasts import sampled_name
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, method_cell, methods_explained, number

_INTRODUCTION = (
    "From every moment of the test trajectories several paths were sampled. The CRPS of a single"
    " path is its absolute error, so the policy's centre, where nothing is drawn, can stand beside"
    " it. "
)


class DistributionsSection(Section):
    """Sampled forecasts: proper scores, coverage, PIT."""

    title = "Sampled forecasts"
    entry = "Distributions"
    order = 800

    def blocks(self, runs: Runs) -> list[Block]:
        """Return plots and a table for each job with sampled forecasts."""
        methods: list[str] = []
        for job in runs.jobs:
            if {"distributions", "forecasts"} <= set(job.tables):
                methods += _names(job.tables["distributions"])
        if not methods:
            return []
        return [
            Text(_INTRODUCTION + caption("distributions")),
            Text(f"Methods: {methods_explained(methods)}"),
            *job_folds(runs, _parts),
        ]


def _parts(job: Job) -> list[Block | None]:
    if not {"distributions", "forecasts"} <= set(job.tables):
        return []
    sheet = crps_sheet(job.tables["distributions"], job.tables["forecasts"])
    return [figure_of("distributions", job), Table(sheet)]


def crps_sheet(table: pd.DataFrame, forecasts: pd.DataFrame) -> Sheet:
    """Returns a row per sampled method and one for the policy's centre, a column per horizon.

    Args:
        table: scores, as a job has written them.
        forecasts: of the same job.
    """
    summary = summarize_distributions(table).set_index(["method", "horizon_s"])
    horizons = sorted(float(horizon) for horizon in table["horizon_s"].unique())
    columns = [Column("Method", number=False)]
    for horizon in horizons:
        meaning = f"CRPS of speed {horizon:g} s after the origin, m/s; below it the coverage."
        columns.append(Column(f"CRPS, {horizon:g} s (m/s)", meaning))
    rows: list[tuple[Cell, ...]] = []
    for method, name in zip(sampled_methods(table), _names(table), strict=False):
        cells = [method_cell(name)]
        for horizon in horizons:
            crps = summary["crps_speed"].get((method, horizon), math.nan)
            coverage = summary["coverage"].get((method, horizon), math.nan)
            cells.append(replace(_number(float(crps)), second=formatted(float(coverage), ".0%")))
        rows.append(tuple(cells))
    centre = centre_errors(forecasts).set_index("horizon_s")["crps_speed"]
    cells = [method_cell("policy")]
    for horizon in horizons:
        cells.append(_number(float(centre.get(horizon, math.nan))))
    rows.append(tuple(cells))
    return Sheet(tuple(columns), tuple(rows))


def _names(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns what the methods are called beside the policy's centre, which stands last."""
    names = []
    for method in sampled_methods(table):
        names.append(sampled_name(method))
    return (*names, "policy")


def _number(value: float) -> Cell:
    return number(value, formatted(value, ".3f"))
