"""Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cfx.plugin import (
    Purpose,
    Result,
    identifiability,
    parameter_spread,  # parameter_spread
    wording,
)
from cfx_report.figures.calibration import SlicePanel, draw_labels, labels_of, slice_panels
from cfx_report.jobs import Runs, of_purpose
from cfx_report.section import Cell, Column, Section, Sheet, View, formatted, job_names, number


class CalibrationSection(Section):
    """Calibrated parameters: their spread over drivers, shares at bounds, correlations."""

    title = "Calibrated parameters"
    entry = "Calibration"
    order = 1400
    template = """
<p>{{ caption("calibration") }}</p>
{% for calibration in calibrations %}
{% call fold(calibration.names, loop.first, "job") %}
{{ drawn("calibration", calibration.job) }}
{{ table(calibration.sheet, explain=loop.first) }}
{% for name in ("identifiability", "posterior_intervals", "posterior_pairs", "posterior_fan",
   "fit_train_test") %}
{% set beyond = drawn(name, calibration.job) %}
{% if beyond %}
<p>{{ caption(name) }}</p>
{{ beyond }}
{% endif %}
{% endfor %}
{% if calibration.labels %}
<p>{{ caption("labels_over_time") }}</p>
{{ figure(calibration.labels,
   "Per-window calibrated parameters over time, and how much they mattered", "Pair") }}
{% endif %}
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return each calibration with the jobs that share it."""
        together: dict[str, list[Result]] = {}
        for job in of_purpose(runs.jobs, Purpose.ADAPTATION, Purpose.CALIBRATION):
            spreads = spreads_of(job)
            if spreads:
                together.setdefault(_fingerprint(spreads), []).append(job)
        calibrations = []
        for jobs in together.values():
            table = sheet(spreads_of(jobs[0]), slices_of(jobs[0]))
            about = {"names": job_names(jobs), "job": jobs[0], "sheet": table}
            calibrations.append({**about, "labels": _labels(jobs)})
        return {"calibrations": calibrations} if calibrations else None


def _labels(jobs: Sequence[Result]) -> dict[str, View]:
    """Returns the per-window parameters of some pairs of the first job that has kept any."""
    for job in jobs:
        views = {}
        if "labels" in job.tables:
            axes = job.parameters
            drivers = labels_of(job.tables["labels"], job.pairs, axes)
            for pair_id, labels in drivers.items():
                views[wording.shortened(pair_id)] = View(draw_labels(pair_id, labels, axes))
        if views:
            return views
    return {}


def slices_of(job: Result) -> tuple[SlicePanel, ...]:
    """Returns the loss along each tuned parameter of a job; () if it has kept none."""
    if "slices" not in job.tables:
        return ()
    return slice_panels(job.tables["slices"], job.parameters)


def spreads_of(job: Result) -> tuple[parameter_spread.ParameterSpread, ...]:
    """Returns the spread of each tuned parameter of a job."""
    return parameter_spread.parameter_spreads(job.pairs, job.parameters)


def _fingerprint(spreads: tuple[parameter_spread.ParameterSpread, ...]) -> str:
    digest = hashlib.sha256()
    for spread in spreads:
        digest.update(spread.axis.name.encode())
        digest.update(spread.values.tobytes())
        digest.update(spread.pooled.tobytes())
    return digest.hexdigest()


class _Row(NamedTuple):
    """A parameter; `near` and `flat` as of `SlicePanel`, NaN where the loss was not examined."""

    spread: parameter_spread.ParameterSpread
    near: float
    flat: float

    def quantile(self, share: float) -> float:
        return float(np.quantile(self.spread.values, share))

    @property
    def pooled(self) -> float:
        return float(self.spread.pooled.mean()) if len(self.spread.pooled) else np.nan


def sheet(
    spreads: Sequence[parameter_spread.ParameterSpread], panels: Sequence[SlicePanel] = ()
) -> Sheet:
    """Returns a row per parameter."""
    examined = {panel.axis.name: (panel.near, panel.flat) for panel in panels}
    unknown = (np.nan, np.nan)
    return Sheet.of(
        _COLUMNS, [_Row(spread, *examined.get(spread.axis.name, unknown)) for spread in spreads]
    )


def _name(row: _Row) -> Cell:
    axis = row.spread.axis
    return Cell(wording.unit_label(axis.name, axis.unit), second=axis.meaning)


def _bounds(row: _Row) -> str:
    assert row.spread.axis.low is not None
    assert row.spread.axis.high is not None
    return (
        f"{wording.number_text(row.spread.axis.low)} to {wording.number_text(row.spread.axis.high)}"
    )


def _middle(row: Any) -> str:
    """Returns the quantiles between which nine in ten of the drivers' values lie."""
    low, high = row.quantile(0.05), row.quantile(0.95)
    return f"{wording.number_text(low)} to {wording.number_text(high)}"


_COLUMNS: tuple[Column[_Row], ...] = (
    Column("Parameter", _name),
    Column("Bounds", _bounds, "Within them calibration has searched."),
    Column("Default", lambda row: number(row.spread.default, ".3g"), "The model's."),
    Column(
        "Pooled", lambda row: number(row.pooled, ".3g"), "Mean over the folds' pooled parameters."
    ),
    Column(
        "Median",
        lambda row: number(row.quantile(0.5), ".3g"),
        "Of the driver-specific values: half of the pairs have more.",
    ),
    Column(
        "5 % to 95 %",
        _middle,
        "Quantiles of the driver-specific values.",
    ),
    Column(
        "At the lower bound",
        lambda row: number(row.spread.at_low, ".0%"),
        f"Share of the pairs within {formatted(parameter_spread.AT_BOUND, '.0%')} of the range of"
        " it.",
    ),
    Column("At the upper bound", lambda row: number(row.spread.at_high, ".0%"), "The same."),
    Column(
        "Flat on",
        lambda row: number(row.near, ".0%"),
        "Share of the range on which the loss is within"
        f" {formatted(identifiability.NEARLY_BEST, '.0%')} of its best, the others"
        " held; median over pairs.",
    ),
    Column(
        "Flat for",
        lambda row: number(row.flat, ".0%"),
        "Share of the pairs for which that is the whole range: these recordings do not"
        " determine the parameter, and its value says nothing of the driver.",
    ),
)
