"""Improvement of every pair, all jobs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cfx.plots.choice.common import natural_order
from cfx.plots.choice.improvements import improvement_bars
from cfx.plots.plotly.figure import Plot, safe, safe_all
from cfx.plots.plotly.improvements import improvements_view
from cfx.plots.words import label, percent_or_undefined, short_label
from cfx.report.blocks import Block, Figure, Section, Text
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs, any_baselines, with_baseline

_INTRODUCTION = (
    "Improvement of every pair on its test part; above 0 the policy is closer to the real driver."
    " The mouse shows pair, driver, cluster and errors; a click on a name in the legend hides a"
    " job."
)
_STATISTICS = ("mean", "ci95_low", "ci95_high")


def blocks(runs: Runs) -> list[Block]:
    """Returns the plot, if any job has a baseline."""
    jobs = with_baseline(runs.jobs)
    if not jobs:
        return []
    return [Text(_INTRODUCTION), Figure(per_driver(jobs))]


def per_driver(jobs: Sequence[Job]) -> Plot:
    """Improvement of every pair; a view per baseline, and an order by each job."""
    tables = [_keyed(job, jobs) for job in jobs]
    keys: dict[str, None] = {}
    for table in tables:
        keys |= dict.fromkeys(table["key"])
    views = {}
    for baseline in any_baselines(jobs):
        views[f"against {label(baseline)}"] = _view(jobs, tables, list(keys), baseline)
    orders = {}
    for name, order in _orders(jobs, tables, list(keys)).items():
        orders[name] = safe_all(order)
    return Plot(views, 460, "Improvement of every pair", orders)


def _keyed(job: Job, jobs: Sequence[Job]) -> pd.DataFrame:
    """Returns the job's pairs with a key that is the same for the same pair of another job."""
    table = job.by_pair.copy()
    keys = table["pair_id"].astype(str)
    if len({str(one.data.get("source", "")) for one in jobs}) > 1:
        keys = keys + f" ({without_folders(str(job.data.get('source', '')))})"
    table["key"] = keys
    return table


def _view(
    jobs: Sequence[Job], tables: Sequence[pd.DataFrame], keys: list[str], baseline: str
) -> dict[str, Any]:
    column = f"improvement/{baseline}"
    names, pair_ids, improvements, hover, marks = [], [], [], [], []
    for job, table in zip(jobs, tables, strict=True):
        if column in table:
            names.append(job.name)
            pair_ids.append(table["key"].tolist())
            improvements.append(table[column].to_numpy(dtype=float))
            hover.append(_hover(job, table, baseline))
            marks += [job.improvement(statistic, baseline) for statistic in _STATISTICS]
    bars = improvement_bars(names, pair_ids, improvements, baseline=baseline, marks=marks)
    return improvements_view(bars, keys, hover)


def _orders(
    jobs: Sequence[Job], tables: Sequence[pd.DataFrame], keys: list[str]
) -> dict[str, list[str]]:
    """Returns the pairs in every order that a reader may choose, by the first job's first."""
    orders: dict[str, list[str]] = {}
    for job, table in zip(jobs, tables, strict=True):
        for baseline in job.baselines():
            gains = table.set_index("key")[f"improvement/{baseline}"]
            known = gains.reindex(keys).replace([np.inf, -np.inf], np.nan)
            ranked = known.sort_values(ascending=False, kind="stable", na_position="last")
            orders[f"improvement over {short_label(baseline)}, {job.name}"] = list(ranked.index)
    every = pd.concat(tables).drop_duplicates("key").set_index("key")
    drivers = every["driver"].astype(str)
    orders["driver"] = sorted(keys, key=lambda key: (natural_order(drivers[key]), key))
    if "style_score" in every:
        scores = every["style_score"].reindex(keys).fillna(0.0)
        orders["style score, conservative first"] = list(scores.sort_values(kind="stable").index)
    return orders


def _hover(job: Job, table: pd.DataFrame, baseline: str) -> dict[str, str]:
    texts = {}
    for _, row in table.iterrows():
        score = row.get("style_score", np.nan)
        style = f", style score {score:.3f}" if np.isfinite(score) else ""
        gain = percent_or_undefined(float(row[f"improvement/{baseline}"]), 1)
        lines = [
            f"<b>pair {safe(row['pair_id'])}</b>",
            f"driver {safe(row['driver'])}, {safe(row['cluster'])}{style}",
            f"{safe(job.name)}: {gain} over {safe(short_label(baseline))}",
        ]
        for what, unit in (("speed", "m/s"), ("gap", "m")):
            errors = []
            for method in job.methods:
                errors.append(f"{safe(short_label(method))} {row[f'rmse_{what}/{method}']:.3f}")
            lines.append(f"RMSE of {what} ({unit}): {', '.join(errors)}")
        texts[str(row["key"])] = "<br>".join(lines)
    return texts


SECTION = Section("drivers", "Driver by driver", "Driver by driver", blocks)
