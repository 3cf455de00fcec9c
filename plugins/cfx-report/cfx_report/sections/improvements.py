"""Improvements of the policy: of every pair, and by cluster of driving style."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd

from cfx.plugin import Improvement, Purpose, Result, improvement_bars, job_folder, style, wording
from cfx_report.figures.jobs import ClusterGroup, draw_clusters, draw_every_pair
from cfx_report.jobs import Runs, any_baselines, of_purpose
from cfx_report.names import SEPARATOR, differences
from cfx_report.section import Cell, Column, Section, Sheet, View, formatted, number
from cfx_report.sections.results import STATISTICS

_STATISTICS = ("geometric", "ci95_low", "ci95_high")

Pair = Mapping[str, Any]
"""A row of `Result.by_pair`."""


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


def per_driver(jobs: Sequence[Result]) -> dict[str, View]:
    """Improvement of every pair; a view per baseline."""
    tables = [_keyed(job, jobs) for job in jobs]
    views = {}
    for baseline in any_baselines(jobs):
        views[f"against {wording.method_label(baseline)}"] = _view(jobs, tables, baseline)
    return views


def _keyed(job: Result, jobs: Sequence[Result]) -> pd.DataFrame:
    """Returns the job's pairs with a key that is the same for the same pair of another job."""
    table = job.by_pair.copy()
    keys = table["pair_id"].astype(str)
    if len({str(other.data.get("source", "")) for other in jobs}) > 1:
        keys = keys + f" ({job_folder.without_folders(str(job.data.get('source', '')))})"
    table["key"] = keys
    return table


def _view(jobs: Sequence[Result], tables: Sequence[pd.DataFrame], baseline: str) -> View:
    column = f"improvement/{baseline}"
    names, pair_ids, improvements, marks = [], [], [], []
    for job, table in zip(jobs, tables, strict=True):
        if column in table:
            names.append(job.name)
            pair_ids.append(table["key"].tolist())
            improvements.append(table[column].to_numpy(dtype=float))
            marks += [getattr(job.statistics(baseline), statistic) for statistic in _STATISTICS]
    bars = improvement_bars.improvement_bars(
        names, pair_ids, improvements, baseline=baseline, marks=marks
    )
    # Best to worst of the first job; pairs that only others have follow.
    keys: dict[str, None] = {}
    for series in bars.series:
        keys |= dict.fromkeys(series.pair_ids)
    return View(draw_every_pair(bars, list(keys)), bars.axis.note)


def pairs_of(job: Result) -> Sheet:
    """Returns a row per pair of a job: its driver, improvements and errors."""
    columns: list[Column[Pair]] = [
        Column("Pair", lambda row: str(row["pair_id"])),
        Column("Driver", lambda row: str(row["driver"])),
        Column("Cluster", lambda row: str(row["cluster"])),
        Column("Style score", partial(_value, "style_score"), "0 conservative, 1 aggressive."),
    ]
    for baseline in job.baselines():
        cell = partial(_value, f"improvement/{baseline}", form="+.1%")
        heading, meaning = (
            f"over {wording.short_label(baseline)}",
            f"Improvement of the {job.judge.heading}.",
        )
        columns.append(Column(heading, cell, meaning, "Improvement of the policy"))
    errors = "RMSE of speed in m/s, below it of gap in m"
    for method in job.methods:
        cell = partial(_errors_of_pair, method)
        columns.append(Column(wording.short_label(method), cell, f"{errors}.", errors))
    # Columns of a data frame may be named by anything; these are named by text.
    return Sheet.of(columns, cast("list[Pair]", job.by_pair.to_dict("records")))


def _value(name: str, row: Pair, form: str = ".3f", second: str = "") -> Cell:
    return number(float(row.get(name, math.nan)), form, second)


def _errors_of_pair(method: str, row: Pair) -> Cell:
    gap = formatted(float(row[f"rmse_gap/{method}"]), ".2f")
    return _value(f"rmse_speed/{method}", row, second=gap)


Series = Mapping[str, Mapping[str, pd.DataFrame]]
"""By name of some jobs and by cluster, some rows of `Result.by_pair`."""


class ClustersSection(Section):
    """Improvement by cluster of driving style."""

    title = "By cluster of driving style"
    entry = "By cluster"
    order = 1300
    template = """
<p>A box reaches from the lower to the upper quartile of the pairs, its line is the median, the
dashed one the mean; the dots are the pairs.</p>
{{ figure(views, "Improvement by cluster of driving style") }}
{% for baseline, sheet in sheets.items() %}
{% call fold("Policy against " ~ baseline, loop.first) %}
{{ table(sheet, explain=loop.first) }}
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the plot and a table per baseline, if any job has a baseline."""
        jobs = of_purpose(runs.jobs, Purpose.ADAPTATION)
        if not jobs:
            return None
        baselines = any_baselines(jobs)
        series = cluster_series(jobs)
        sheets = {
            wording.method_label(baseline): clusters(series, baseline) for baseline in baselines
        }
        return {"views": per_cluster(series, baselines), "sheets": sheets}


def cluster_series(jobs: Sequence[Result]) -> dict[str, dict[str, pd.DataFrame]]:
    """Returns the pairs by series of jobs and cluster.

    A job that uses every driver is a series; jobs that differ in `style.cluster` alone are one
    together.
    """
    series: dict[str, dict[str, pd.DataFrame]] = {}
    parts = differences(jobs, ignored=("style.cluster",))
    for job, family in zip(jobs, parts, strict=True):
        clusters = _by_cluster(job.by_pair)
        name = job.name
        if job.setting("style.cluster") not in {None, "all"}:
            together = f"{SEPARATOR.join(family)}, a job for each cluster"
            # The same cluster twice: the jobs differ in nothing that has a name.
            if not set(clusters) & set(series.get(together, {})):
                name = together
        series.setdefault(name, {}).update(clusters)
    ordered: dict[str, dict[str, pd.DataFrame]] = {}
    for name, by_cluster in series.items():
        ordered[name] = {}
        for cluster in style.CLUSTERS:
            if cluster in by_cluster:
                ordered[name][cluster] = by_cluster[cluster]
    return ordered


def _by_cluster(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    by_cluster = {}
    for cluster in style.CLUSTERS:
        rows = table[table["cluster"] == cluster]
        if len(rows):
            by_cluster[cluster] = rows
    return by_cluster


def per_cluster(series: Series, baselines: Sequence[str]) -> dict[str, View]:
    """Distribution of the improvement by cluster; a view per baseline."""
    views = {}
    for baseline in baselines:
        column = f"improvement/{baseline}"
        groups = []
        for name, by_cluster in series.items():
            tables = [table for table in by_cluster.values() if column in table]
            if tables:
                groups.append(_group(name, pd.concat(tables, ignore_index=True), column))
        every = np.concatenate([np.empty(0), *(group.values for group in groups)])
        axis = improvement_bars.improvement_axis(every, baseline=baseline)
        views[f"against {wording.method_label(baseline)}"] = View(
            draw_clusters(groups, axis), axis.note
        )
    return views


def _group(name: str, pairs: pd.DataFrame, column: str) -> ClusterGroup:
    ids, clusters = pairs["pair_id"].astype(str), pairs["cluster"].astype(str)
    values = pairs[column].to_numpy(dtype=float)
    return ClusterGroup(name, tuple(clusters), tuple(ids), values)


class _Row(NamedTuple):
    jobs: str
    cluster: str
    improvement: Improvement


def clusters(series: Series, baseline: str) -> Sheet:
    """Returns the improvement over a baseline by cluster."""
    rows = []
    for name, by_cluster in series.items():
        for cluster, table in by_cluster.items():
            # Jobs without this baseline may stand beside others that have it.
            if f"improvement/{baseline}" in table:
                rows.append(_Row(name, cluster, improvement_of(table, baseline)))
    columns: tuple[Column[_Row], ...] = (
        Column("Jobs", lambda row: row.jobs),
        Column(
            "Cluster",
            lambda row: Cell(
                row.cluster, str(style.CLUSTERS.index(row.cluster)), colour=row.cluster
            ),
            "A quarter of the drivers, a half and a quarter by style score, unless the cuts say"
            " otherwise.",
        ),
        Column(
            "Pairs",
            lambda row: number(row.improvement.pairs, "d"),
            "Pairs of drivers of this cluster whose improvement is defined.",
        ),
    )
    shared = [replace(column, meaning="As above.") for column in STATISTICS[:5]]
    shared[0] = replace(shared[0], meaning=f"Improvement over {wording.explained(baseline)}.")
    return Sheet.of([*columns, *shared], rows)


def improvement_of(table: pd.DataFrame, baseline: str) -> Improvement:
    """Returns the statistics over some pairs, as an evaluation makes them.

    Args:
        table: some rows of `Result.by_pair`.
        baseline: what the policy is compared with.
    """
    from cfx.plugin import statistics  # imports scipy

    # Errors relative to the baseline's: of each job those of the metric that it is judged by.
    after = 1.0 - table[f"improvement/{baseline}"].to_numpy(dtype=float)
    return statistics.improvement_statistics(
        np.ones_like(after), after, table["driver"].astype(str).tolist()
    )
