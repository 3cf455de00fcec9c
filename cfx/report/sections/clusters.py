"""Improvement by cluster of driving style."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from cfx.data.style import CLUSTERS
from cfx.evaluation.result import Purpose
from cfx.evaluation.statistics import Improvement
from cfx.report.blocks import Block, Figure, Fold, Table, Text
from cfx.report.figure_blocks import view
from cfx.report.figures.improvements import improvement_axis
from cfx.report.figures.jobs import ClusterGroup, draw_clusters
from cfx.report.figures.words import explained, label
from cfx.report.job import Job, Runs, any_baselines, of_purpose
from cfx.report.names import SEPARATOR, differences
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, interval, number, share, text

Series = Mapping[str, Mapping[str, pd.DataFrame]]
"""By name of some jobs and by cluster, some rows of `Job.by_pair`."""

_INTRODUCTION = (
    "A box reaches from the lower to the upper quartile of the pairs, its line is the median, the"
    " dashed one the mean; the dots are the pairs."
)


class ClustersSection(Section):
    """Improvement by cluster of driving style."""

    title = "By cluster of driving style"
    entry = "By cluster"
    order = 1300

    def blocks(self, runs: Runs) -> list[Block]:
        """Return the plot and a table per baseline, if any job has a baseline."""
        jobs = of_purpose(runs.jobs, Purpose.ADAPTATION)
        if not jobs:
            return []
        baselines = any_baselines(jobs)
        series = cluster_series(jobs)
        found: list[Block] = [Text(_INTRODUCTION), per_cluster(series, baselines)]
        for k, baseline in enumerate(baselines):
            first = k == 0
            table = Table(clusters(series, baseline), explain=first)
            found.append(Fold(f"Policy against {label(baseline)}", (table,), unfolded=first))
        return found


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


def per_cluster(series: Series, baselines: Sequence[str]) -> Figure:
    """Distribution of the improvement by cluster; a view per baseline.

    Args:
        series: the pairs.
        baselines: what the policy is compared with.
    """
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
        views[f"against {label(baseline)}"] = view(draw_clusters(groups, axis), axis.note)
    return Figure(views, "Improvement by cluster of driving style")


def _group(name: str, pairs: pd.DataFrame, column: str) -> ClusterGroup:
    ids, clusters = pairs["pair_id"].astype(str), pairs["cluster"].astype(str)
    values = pairs[column].to_numpy(dtype=float)
    return ClusterGroup(name, tuple(clusters), tuple(ids), values)


def clusters(series: Series, baseline: str) -> Sheet:
    """Returns the improvement by cluster.

    Args:
        series: the pairs.
        baseline: what the policy is compared with.
    """
    columns = (
        Column("Jobs", number=False),
        Column(
            "Cluster",
            "A quarter of the drivers, a half and a quarter by style score, unless the cuts say"
            " otherwise.",
            number=False,
        ),
        Column("Pairs", "Pairs of drivers of this cluster whose improvement is defined."),
        Column("Mean", f"Improvement over {explained(baseline)}."),
        Column("95 % interval", "Of the mean, as above."),
        Column("Trimmed mean", "As above."),
        Column("Median", "As above."),
        Column("Better for", "As above."),
    )
    rows = []
    for name, by_cluster in series.items():
        for cluster, table in by_cluster.items():
            # Jobs without this baseline may stand beside others that have it.
            if f"rmse_speed/{baseline}" in table:
                rows.append((text(name), *_row(cluster, statistics(table, baseline))))
    return Sheet(columns, tuple(rows))


def _row(cluster: str, found: Improvement) -> tuple[Cell, ...]:
    place = str(CLUSTERS.index(cluster)) if cluster in CLUSTERS else cluster
    return (
        Cell(cluster, place, colour=cluster),
        number(found.pairs, str(found.pairs)),
        share(found.mean),
        interval(found.ci95_low, found.ci95_high),
        share(found.trimmed_mean),
        share(found.median),
        number(found.win_rate, formatted(found.win_rate, ".0%")),
    )


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
