"""Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cfx.calibration.flatness import NEAR
from cfx.evaluation.result import Purpose
from cfx.report.blocks import Block, Figure, Table, Text, job_fold
from cfx.report.figure_blocks import caption, figure_of, view
from cfx.report.figures.calibration import AT_BOUND, ParameterSpread, parameter_spreads
from cfx.report.figures.identifiability import SlicePanel, draw_labels, labels_of, slice_panels
from cfx.report.figures.words import number as shown_number
from cfx.report.figures.words import short, unit_label
from cfx.report.job import Job, Runs, of_purpose
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, job_names, number, text


class CalibrationSection(Section):
    """Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

    title = "Calibrated parameters"
    entry = "Calibration"
    order = 1400

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a plot and a table for each calibration, with the jobs that share it."""
        together: dict[str, list[Job]] = {}
        for job in of_purpose(runs.jobs, Purpose.ADAPTATION, Purpose.CALIBRATION):
            spreads = spreads_of(job)
            if spreads:
                together.setdefault(_fingerprint(spreads), []).append(job)
        found: list[Block] = []
        for k, jobs in enumerate(together.values()):
            spreads = spreads_of(jobs[0])
            table = Table(sheet(spreads, slices_of(jobs[0])), explain=k == 0)
            parts = [figure_of("calibration", jobs[0]), table, *_beyond(jobs)]
            shown = [part for part in parts if part is not None]
            found.append(job_fold(job_names(jobs), shown, first=k == 0))
        return [Text(caption("calibration")), *found] if found else []


def _beyond(jobs: Sequence[Job]) -> list[Block]:
    """Returns what calibration found beyond its parameters, as far as a job has kept it."""
    found: list[Block] = []
    for name in ("identifiability", "fit_train_test"):
        figure = figure_of(name, jobs[0])
        if figure is not None:
            found += [Text(caption(name)), figure]
    kept = [job for job in jobs if "labels" in job.tables]
    for job in kept:
        results = job.results
        views = {}
        drivers = labels_of(job.tables["labels"], results.pairs, results.parameters)
        for pair_id, labels in drivers.items():
            views[short(pair_id)] = view(draw_labels(pair_id, labels, results.parameters))
        if views:
            title = "Per-window calibrated parameters over time, and how much they mattered"
            return [*found, Text(caption("labels_over_time")), Figure(views, title, "Pair")]
    return found


def slices_of(job: Job) -> tuple[SlicePanel, ...]:
    """Returns the loss along each tuned parameter of a job; () if it has kept none."""
    if "slices" not in job.tables:
        return ()
    return slice_panels(job.tables["slices"], job.described_parameters)


def spreads_of(job: Job) -> tuple[ParameterSpread, ...]:
    """Returns the spread of each tuned parameter of a job."""
    return parameter_spreads(job.pairs, job.described_parameters)


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
