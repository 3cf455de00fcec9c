"""Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from cfx.plots.choice.calibration import (
    AT_BOUND,
    ParameterSpread,
    correlations,
    parameter_spreads,
)
from cfx.plots.choice.trajectories import ParameterAxis
from cfx.plots.plotly.calibration import calibration_plot
from cfx.plots.words import number as shown_number
from cfx.plots.words import pretty_unit
from cfx.report.blocks import Block, Figure, Section, Table, Text, job_fold
from cfx.report.job import Job, Runs, with_constant_baseline
from cfx.report.tables import Cell, Column, Sheet, formatted, job_names, number, text

_INTRODUCTION = (
    "Each driver's own parameters (a dot per pair), calibrated on the first part of their"
    " trajectory; pooled and default parameters beside them. Where values gather at a bound, or"
    " spread over the whole range, these recordings may hardly determine the parameter."
)


def blocks(runs: Runs) -> list[Block]:
    """Returns a plot and a table for each different calibration, with the jobs that share it."""
    together: dict[str, list[Job]] = {}
    for job in with_constant_baseline(runs.jobs):
        spreads = spreads_of(job)
        if spreads:
            together.setdefault(_fingerprint(spreads), []).append(job)
    found: list[Block] = []
    for k, jobs in enumerate(together.values()):
        spreads = spreads_of(jobs[0])
        table = correlations(jobs[0].pairs, [spread.axis for spread in spreads])
        parts = [Figure(calibration_plot(spreads, table)), Table(sheet(spreads), explain=k == 0)]
        found.append(job_fold(job_names(jobs), parts, first=k == 0))
    return [Text(_INTRODUCTION), *found] if found else []


def spreads_of(job: Job) -> tuple[ParameterSpread, ...]:
    """Returns the spread of each tuned parameter of a job."""
    return parameter_spreads(job.pairs, _axes(job))


def _axes(job: Job) -> list[ParameterAxis]:
    """Returns the parameters of `data.json`, which stand there whatever else a job has written."""
    axes = []
    for about in job.data.get("parameters") or ():
        low, high = about.get("low"), about.get("high")
        if isinstance(low, int | float) and isinstance(high, int | float):
            name, unit = str(about.get("name")), str(about.get("unit", ""))
            meaning = str(about.get("meaning", ""))
            axes.append(ParameterAxis(name, unit, float(low), float(high), meaning))
    return axes


def _fingerprint(spreads: tuple[ParameterSpread, ...]) -> str:
    found = hashlib.sha256()
    for spread in spreads:
        found.update(spread.axis.name.encode())
        found.update(spread.values.tobytes())
        found.update(spread.pooled.tobytes())
    return found.hexdigest()


def sheet(spreads: tuple[ParameterSpread, ...]) -> Sheet:
    """Returns a row per parameter."""
    near = f"{AT_BOUND:.0%}".replace("%", " %")
    columns = (
        Column("Parameter", number=False),
        Column("Unit", number=False),
        Column("Bounds", "Within them calibration has searched.", number=False),
        Column("Default", "The model's."),
        Column("Pooled", "Mean over the folds' pooled parameters."),
        Column("Median", "Of the driver-specific values: half of the pairs have more."),
        Column("5 % to 95 %", "Quantiles of the driver-specific values.", number=False),
        Column("At the lower bound", f"Share of the pairs within {near} of the range of it."),
        Column("At the upper bound", "The same."),
    )
    return Sheet(columns, tuple(_row(spread) for spread in spreads))


def _row(spread: ParameterSpread) -> tuple[Cell, ...]:
    axis = spread.axis
    assert axis.low is not None
    assert axis.high is not None
    low, median, high = np.quantile(spread.values, (0.05, 0.5, 0.95))
    pooled = float(spread.pooled.mean()) if len(spread.pooled) else float("nan")
    return (
        replace(text(axis.name), second=axis.meaning),
        text(pretty_unit(axis.unit)),
        text(f"{shown_number(axis.low)} to {shown_number(axis.high)}"),
        number(spread.default, shown_number(spread.default)),
        number(pooled, shown_number(pooled)),
        number(float(median), shown_number(float(median))),
        text(f"{shown_number(float(low))} to {shown_number(float(high))}"),
        number(spread.at_low, formatted(spread.at_low, ".0%")),
        number(spread.at_high, formatted(spread.at_high, ".0%")),
    )


SECTION = Section("calibration", "Calibrated parameters", "Calibration", blocks)
