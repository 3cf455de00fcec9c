"""Improvement by cluster of driving style."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from cfx.data.style import CLUSTERS
from cfx.evaluation.result import Purpose
from cfx.evaluation.statistics import Improvement
from cfx.report.figures.improvements import improvement_axis
from cfx.report.figures.jobs import ClusterGroup, draw_clusters
from cfx.report.figures.text import explained, label
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.names import SEPARATOR, differences
from cfx.report.section import Section, View
from cfx.report.tables import Cell, Column, Sheet, interval, number

Series = Mapping[str, Mapping[str, pd.DataFrame]]
"""By name of some jobs and by cluster, some rows of `Job.by_pair`."""


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
        sheets = {label(baseline): clusters(series, baseline) for baseline in baselines}
        return {"views": per_cluster(series, baselines), "sheets": sheets}


def cluster_series(jobs: Sequence[Job]) -> dict[str, dict[str, pd.DataFrame]]:
    """Returns the pairs by series of jobs and cluster.

    A job that uses every driver is a series; jobs that differ in `style.cluster` alone are one
    together.
    """
    series: dict[str, dict[str, pd.DataFrame]] = {}
    parts = differences(jobs, ignored=("style.cluster",))
    for job, family in zip(jobs, parts, strict=True):
        found = _by_cluster(job.by_pair)
        name = job.name
        if job.setting("style.cluster") not in {None, "all"}:
            together = f"{SEPARATOR.join(family)}, a job for each cluster"
            # The same cluster twice: the jobs differ in nothing that has a name.
            if not set(found) & set(series.get(together, {})):
                name = together
        series.setdefault(name, {}).update(found)
    ordered = {}
    for name, by_cluster in series.items():
        ordered[name] = {c: by_cluster[c] for c in CLUSTERS if c in by_cluster}
    return ordered


def _by_cluster(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    found = {}
    for cluster in CLUSTERS:
        rows = table[table["cluster"] == cluster]
        if len(rows):
            found[cluster] = rows
    return found


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
        axis = improvement_axis(every, baseline=baseline)
        views[f"against {label(baseline)}"] = View(draw_clusters(groups, axis), axis.note)
    return views


def _group(name: str, pairs: pd.DataFrame, column: str) -> ClusterGroup:
    ids, clusters = pairs["pair_id"].astype(str), pairs["cluster"].astype(str)
    values = pairs[column].to_numpy(dtype=float)
    return ClusterGroup(name, tuple(clusters), tuple(ids), values)


class _Row(NamedTuple):
    jobs: str
    cluster: str
    found: Improvement


def clusters(series: Series, baseline: str) -> Sheet:
    """Returns the improvement over a baseline by cluster."""
    rows = []
    for name, by_cluster in series.items():
        for cluster, table in by_cluster.items():
            # Jobs without this baseline may stand beside others that have it.
            if f"rmse_speed/{baseline}" in table:
                rows.append(_Row(name, cluster, statistics(table, baseline)))
    columns: tuple[Column[_Row], ...] = (
        Column("Jobs", lambda row: row.jobs),
        Column(
            "Cluster",
            lambda row: Cell(row.cluster, str(CLUSTERS.index(row.cluster)), colour=row.cluster),
            "A quarter of the drivers, a half and a quarter by style score, unless the cuts say"
            " otherwise.",
        ),
        Column(
            "Pairs",
            lambda row: number(row.found.pairs, "d"),
            "Pairs of drivers of this cluster whose improvement is defined.",
        ),
        Column(
            "Mean",
            lambda row: number(row.found.mean, "+.1%"),
            f"Improvement over {explained(baseline)}.",
        ),
        Column(
            "95 % interval",
            lambda row: interval(row.found.ci95_low, row.found.ci95_high),
            "Of the mean, as above.",
        ),
        Column("Trimmed mean", lambda row: number(row.found.trimmed_mean, "+.1%"), "As above."),
        Column("Median", lambda row: number(row.found.median, "+.1%"), "As above."),
        Column("Better for", lambda row: number(row.found.win_rate, ".0%"), "As above."),
    )
    return Sheet.of(columns, rows)


def statistics(table: pd.DataFrame, baseline: str) -> Improvement:
    """Returns the statistics over some pairs, as an evaluation makes them.

    Args:
        table: some rows of `Job.by_pair`.
        baseline: what the policy is compared with.
    """
    from cfx.evaluation.statistics import improvement_statistics  # imports scipy

    before = table[f"rmse_speed/{baseline}"].to_numpy(dtype=float)
    after = table["rmse_speed/policy"].to_numpy(dtype=float)
    return improvement_statistics(before, after, table["driver"].astype(str).tolist(), seed=0)
