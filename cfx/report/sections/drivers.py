"""Improvement of every pair, all jobs beside each other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd

from cfx.evaluation.result import Purpose
from cfx.report.figures.improvements import improvement_bars
from cfx.report.figures.jobs import draw_every_pair
from cfx.report.figures.text import label, short_label
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.section import Section, View
from cfx.report.tables import Cell, Column, Sheet, formatted, number

_STATISTICS = ("mean", "ci95_low", "ci95_high")

Pair = Mapping[str, Any]
"""A row of `Job.by_pair`."""


class DriversSection(Section):
    """Improvement of every pair, all jobs beside each other."""

    title = "Driver by driver"
    entry = "Driver by driver"
    order = 1200
    template = """
<p>Improvement of every pair on its test part, in the order of the first job; above 0 the policy is
closer to the real driver. The mouse shows the pair; a click on a heading of the tables sorts pairs
by driver, style or errors.</p>
{{ figure(views, "Improvement of every pair") }}
{% for name, sheet in sheets.items() %}
{% call fold("Every pair: " ~ name) %}{{ table(sheet, compact=true) }}{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the plot and a table per job, if any job has a baseline."""
        jobs = of_purpose(runs.jobs, Purpose.ADAPTATION)
        if not jobs:
            return None
        return {"views": per_driver(jobs), "sheets": {job.name: pairs_of(job) for job in jobs}}


def per_driver(jobs: Sequence[Job]) -> dict[str, View]:
    """Improvement of every pair; a view per baseline."""
    tables = [_keyed(job, jobs) for job in jobs]
    views = {}
    for baseline in any_baselines(jobs):
        views[f"against {label(baseline)}"] = _view(jobs, tables, baseline)
    return views


def _keyed(job: Job, jobs: Sequence[Job]) -> pd.DataFrame:
    """Returns the job's pairs with a key that is the same for the same pair of another job."""
    table = job.by_pair.copy()
    keys = table["pair_id"].astype(str)
    if len({str(one.data.get("source", "")) for one in jobs}) > 1:
        keys = keys + f" ({without_folders(str(job.data.get('source', '')))})"
    table["key"] = keys
    return table


def _view(jobs: Sequence[Job], tables: Sequence[pd.DataFrame], baseline: str) -> View:
    column = f"improvement/{baseline}"
    names, pair_ids, improvements, marks = [], [], [], []
    for job, table in zip(jobs, tables, strict=True):
        if column in table:
            names.append(job.name)
            pair_ids.append(table["key"].tolist())
            improvements.append(table[column].to_numpy(dtype=float))
            marks += [job.improvement(statistic, baseline) for statistic in _STATISTICS]
    bars = improvement_bars(names, pair_ids, improvements, baseline=baseline, marks=marks)
    # Best to worst of the first job; pairs that only others have follow.
    keys: dict[str, None] = {}
    for series in bars.series:
        keys |= dict.fromkeys(series.pair_ids)
    return View(draw_every_pair(bars, list(keys)), bars.axis.note)


def pairs_of(job: Job) -> Sheet:
    """Returns a row per pair of a job: its driver, improvements and errors."""
    columns = [
        Column[Pair]("Pair", lambda row: str(row["pair_id"])),
        Column("Driver", lambda row: str(row["driver"])),
        Column("Cluster", lambda row: str(row["cluster"])),
        Column("Style score", partial(_value, "style_score"), "0 conservative, 1 aggressive."),
    ]
    for baseline in job.baselines():
        cell = partial(_value, f"improvement/{baseline}", form="+.1%")
        heading, meaning = f"over {short_label(baseline)}", "Improvement of the RMSE of speed."
        columns.append(Column(heading, cell, meaning, "Improvement of the policy"))
    errors = "RMSE of speed in m/s, below it of gap in m"
    for method in job.methods:
        cell = partial(_error, method)
        columns.append(Column(short_label(method), cell, f"{errors}.", errors))
    return Sheet.of(columns, job.by_pair.to_dict("records"))


def _value(name: str, row: Pair, form: str = ".3f", second: str = "") -> Cell:
    return number(float(row.get(name, math.nan)), form, second)


def _error(method: str, row: Pair) -> Cell:
    gap = formatted(float(row[f"rmse_gap/{method}"]), ".2f")
    return _value(f"rmse_speed/{method}", row, second=gap)
