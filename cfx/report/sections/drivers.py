"""Improvement of every pair, all jobs beside each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from cfx.evaluation.result import Purpose
from cfx.report.blocks import Block, Figure, Fold, Table, Text, View
from cfx.report.figure_blocks import view
from cfx.report.figures.improvements import improvement_bars
from cfx.report.figures.jobs import draw_every_pair
from cfx.report.figures.words import label, short_label
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.section import Section
from cfx.report.tables import Column, Sheet, formatted, number, share, text

_INTRODUCTION = (
    "Improvement of every pair on its test part, in the order of the first job; above 0 the policy"
    " is closer to the real driver. The mouse shows the pair; a click on a heading of the tables"
    " sorts pairs by driver, style or errors."
)
_STATISTICS = ("mean", "ci95_low", "ci95_high")


class DriversSection(Section):
    """Improvement of every pair, all jobs beside each other."""

    title = "Driver by driver"
    entry = "Driver by driver"
    order = 1200

    def blocks(self, runs: Runs) -> list[Block]:
        """Return the plot, if any job has a baseline."""
        jobs = of_purpose(runs.jobs, Purpose.ADAPTATION)
        if not jobs:
            return []
        found: list[Block] = [Text(_INTRODUCTION), per_driver(jobs)]
        for job in jobs:
            found.append(Fold(f"Every pair: {job.name}", (Table(pairs_of(job), compact=True),)))
        return found


def per_driver(jobs: Sequence[Job]) -> Figure:
    """Improvement of every pair; a view per baseline."""
    tables = [_keyed(job, jobs) for job in jobs]
    views = {}
    for baseline in any_baselines(jobs):
        views[f"against {label(baseline)}"] = _view(jobs, tables, baseline)
    return Figure(views, "Improvement of every pair")


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
    return view(draw_every_pair(bars, list(keys)), bars.axis.note)


def pairs_of(job: Job) -> Sheet:
    """Returns a row per pair of a job: its driver, improvements and errors."""
    columns = [
        Column("Pair", number=False),
        Column("Driver", number=False),
        Column("Cluster", number=False),
        Column("Style score", "0 conservative, 1 aggressive."),
    ]
    for baseline in job.baselines():
        columns.append(Column(f"over {short_label(baseline)}", "Improvement of the RMSE of speed."))
    for method in job.methods:
        meaning = "RMSE of speed in m/s, below it of gap in m."
        columns.append(Column(short_label(method), meaning))
    rows = []
    for row in job.by_pair.to_dict("records"):
        score = float(row.get("style_score", math.nan))
        cells = [text(str(row["pair_id"])), text(str(row["driver"])), text(str(row["cluster"]))]
        cells.append(number(score, formatted(score, ".3f")))
        cells += [share(float(row[f"improvement/{one}"])) for one in job.baselines()]
        for method in job.methods:
            speed = float(row[f"rmse_speed/{method}"])
            gap = formatted(float(row[f"rmse_gap/{method}"]), ".2f")
            cells.append(replace(number(speed, formatted(speed, ".3f")), second=gap))
        rows.append(tuple(cells))
    groups = (("", 4), ("Improvement of the policy", len(job.baselines())))
    errors = ("RMSE of speed in m/s, below it of gap in m", len(job.methods))
    return Sheet(tuple(columns), tuple(rows), (*groups, errors))
