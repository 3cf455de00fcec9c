"""Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cfx.calibration.flatness import NEAR
from cfx.plots.choice.calibration import (
    AT_BOUND,
    ParameterSpread,
    correlations,
    parameter_spreads,
)
from cfx.plots.choice.identifiability import (
    Fit,
    SlicePanel,
    fits_of,
    labels_of,
    slice_panels,
)
from cfx.plots.choice.trajectories import ParameterAxis
from cfx.plots.plotly.calibration import calibration_plot
from cfx.plots.plotly.identifiability import fits_plot, labels_plot, slices_plot
from cfx.plots.words import number as shown_number
from cfx.plots.words import unit_label
from cfx.report.blocks import Block, Figure, Section, Table, Text, job_fold
from cfx.report.job import Job, Runs, with_constant_baseline
from cfx.report.tables import Cell, Column, Sheet, formatted, job_names, number, text

_INTRODUCTION = (
    "Each driver's own parameters (a dot per pair), calibrated on the first part of their"
    " trajectory; pooled and default parameters beside them. Where values gather at a bound, or"
    " spread over the whole range, these recordings may hardly determine the parameter."
)

_SLICES = (
    "How well the recordings determine each parameter: one is moved from bound to bound, the others"
    " stay at the driver's calibrated values. Where the loss stays near its best (dashed: 5 %"
    " above), the parameter is not determined. Where it rises, others might still make up for it."
)

_FITS = (
    "Each driver's error on the part of their trajectory that was calibrated on, against that on"
    " the test part. Where a driver-specific dot lies far above the line, its parameters were"
    " fitted to more than the driver's style."
)

_LABELS = (
    "Per-window calibrated parameters (labels) over time. Pale ones hardly mattered in their"
    " window, so that their values are arbitrary. The sensitivity below says how much a choice"
    " mattered, in the objective's unit."
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
        parts: list[Block] = [Figure(calibration_plot(spreads, table))]
        panels = slices_of(jobs[0])
        parts += [Table(sheet(spreads, panels), explain=k == 0), *_beyond(jobs, panels)]
        found.append(job_fold(job_names(jobs), parts, first=k == 0))
    return [Text(_INTRODUCTION), *found] if found else []


def _beyond(jobs: Sequence[Job], panels: Sequence[SlicePanel]) -> list[Block]:
    """Returns what calibration found beyond its parameters, as far as a job has kept it."""
    found: list[Block] = []
    if panels:
        found += [Text(_SLICES), Figure(slices_plot(panels))]
    fits: tuple[Fit, ...] = ()
    if jobs[0].fits is not None:
        fits = fits_of(jobs[0].fits)
    if fits:
        found += [Text(_FITS), Figure(fits_plot(fits))]
    for job in jobs:
        if job.labels is not None:
            drivers = labels_of(job.labels, job.pairs, _axes(job))
            if drivers:
                found += [Text(_LABELS), Figure(labels_plot(drivers, _axes(job)))]
                break
    return found


def slices_of(job: Job) -> tuple[SlicePanel, ...]:
    """Returns the loss along each tuned parameter of a job; () if it has kept none."""
    if job.slices is None:
        return ()
    return slice_panels(job.slices, _axes(job))


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


def sheet(spreads: Sequence[ParameterSpread], panels: Sequence[SlicePanel] = ()) -> Sheet:
    """Returns a row per parameter."""
    at = f"{AT_BOUND:.0%}".replace("%", " %")
    columns = (
        Column("Parameter", number=False),
        Column("Bounds", "Within them calibration has searched.", number=False),
        Column("Default", "The model's."),
        Column("Pooled", "Mean over the folds' pooled parameters."),
        Column("Median", "Of the driver-specific values: half of the pairs have more."),
        Column("5 % to 95 %", "Quantiles of the driver-specific values.", number=False),
        Column("At the lower bound", f"Share of the pairs within {at} of the range of it."),
        Column("At the upper bound", "The same."),
        Column(
            "Flat on",
            f"Share of the range on which the loss is within {NEAR:.0%} of its best, the others"
            " held; median over pairs.".replace("%", " %", 1),
        ),
        Column(
            "Flat for",
            "Share of the pairs for which that is the whole range: these recordings do not"
            " determine the parameter, and its value says nothing of the driver.",
        ),
    )
    of_name = {panel.axis.name: panel for panel in panels}
    return Sheet(columns, tuple(_row(spread, of_name) for spread in spreads))


def _row(spread: ParameterSpread, panels: Mapping[str, SlicePanel]) -> tuple[Cell, ...]:
    axis = spread.axis
    assert axis.low is not None
    assert axis.high is not None
    share = flat = float("nan")
    if axis.name in panels:
        share, flat = panels[axis.name].near, panels[axis.name].flat
    low, median, high = np.quantile(spread.values, (0.05, 0.5, 0.95))
    pooled = float(spread.pooled.mean()) if len(spread.pooled) else float("nan")
    return (
        replace(text(unit_label(axis.name, axis.unit)), second=axis.meaning),
        text(f"{shown_number(axis.low)} to {shown_number(axis.high)}"),
        number(spread.default, shown_number(spread.default)),
        number(pooled, shown_number(pooled)),
        number(float(median), shown_number(float(median))),
        text(f"{shown_number(float(low))} to {shown_number(float(high))}"),
        number(spread.at_low, formatted(spread.at_low, ".0%")),
        number(spread.at_high, formatted(spread.at_high, ".0%")),
        number(share, formatted(share, ".0%")),
        number(flat, formatted(flat, ".0%")),
    )


SECTION = Section("calibration", "Calibrated parameters", "Calibration", blocks)
