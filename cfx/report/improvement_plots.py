"""Plots of the improvement: by job, by driver, by cluster."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from cfx.figures.look import COLOURS, INK, LABELS, percent
from cfx.report.figure import (
    Array,
    Plot,
    Trace,
    axis,
    cut,
    improvement_axis,
    job_style,
    safe,
    view,
    zero_line,
)
from cfx.report.read import Job, finite, improvement_of
from cfx.style.result import CLUSTERS

_NAMED = 90
"""Up to so many pairs carry their names under the axis."""

_WHERE = {"": "", "later/": ", beyond the first 5 s", "whole/": ", whole drives"}
"""The frames that improvements are of, as their metrics begin, and in words."""

_BARS = 3
"""Up to so many jobs are drawn as bars beside each other, more as dots."""


def overview(jobs: Sequence[Job]) -> Plot:
    """Mean improvement with its 95 % interval, trimmed mean and median: a line per job; a view per baseline and frames."""
    kinds = [
        (b, where)
        for where in _WHERE
        for b in dict.fromkeys(b for job in jobs for b in job.baselines(where))
    ]
    views = {
        _against(baseline) + _WHERE[where]: _overview_view(jobs, baseline, where)
        for baseline, where in kinds
    }
    return Plot(views, 120 + 34 * len(jobs), "Mean improvement of each job with its 95 % interval")


def _against(baseline: str) -> str:
    return f"against {LABELS.get(baseline, baseline)}"


def _overview_view(jobs: Sequence[Job], baseline: str, where: str) -> dict[str, Any]:
    shown = [job for job in jobs if baseline in job.baselines(where)]
    names = ("mean", "ci95_low", "ci95_high", "trimmed_mean", "median")
    values = np.array(
        [
            [job.metrics.get(f"{improvement_of(baseline, where)}/{name}", np.nan) for name in names]
            for job in shown
        ]
    )
    places = np.arange(len(shown))[::-1]
    common = {
        "type": "scatter",
        "mode": "markers",
        "y": places,
        "text": [
            _overview_hover(safe(job.name), row) for job, row in zip(shown, values, strict=True)
        ],
        "hovertemplate": "%{text}<extra></extra>",
    }
    mean, low, high, trimmed, median = values.T
    distance = {
        "type": "data",
        "symmetric": False,
        "array": high - mean,
        "arrayminus": mean - low,
        "thickness": 2,
        "width": 5,
    }
    dot = {"size": 12, "color": COLOURS.get(baseline, INK)}
    data: list[Trace] = [
        common
        | {
            "x": mean,
            "name": "mean and its 95 % interval",
            "error_x": distance,
            "marker": dot,
        },
        common
        | {
            "x": trimmed,
            "name": "trimmed mean",
            "marker": {"symbol": "diamond-open", "size": 11, "color": "black"},
        },
        common
        | {
            "x": median,
            "name": "median",
            "marker": {"symbol": "line-ns-open", "size": 13, "color": "black"},
        },
    ]
    left, note = cut(
        values[:, [0, 1, 3, 4]].ravel(), "means, medians and ends of intervals are lower"
    )
    right = float(finite(values.ravel()).max(initial=0.0))
    margin = 0.05 * max(right - left, 0.1)
    layout = {
        "xaxis": axis(
            f"improvement over {LABELS.get(baseline, safe(baseline))}",
            range=[left - margin, right + margin],
            tickformat=".0%",
        ),
        "yaxis": axis(
            tickvals=places,
            ticktext=[safe(job.name) for job in shown],
            range=[-0.6, len(shown) - 0.4],
            showgrid=False,
            ticks="",
        ),
        "shapes": [zero_line("x")],
    }
    return view(data, layout, note)


def _overview_hover(label: str, values: Array) -> str:
    mean, low, high, trimmed, median = (
        percent(value, 1) if np.isfinite(value) else "not defined" for value in values
    )
    return f"<b>{label}</b><br>mean {mean}<br>95 % interval {low} to {high}<br>trimmed mean {trimmed}<br>median {median}"


def per_driver(jobs: Sequence[Job]) -> Plot:
    """Improvement of every pair, all jobs beside each other; a view per baseline, and an order by each job."""
    tables = [job.by_pair.copy() for job in jobs]
    several = len({str(job.data.get("source", "")) for job in jobs}) > 1
    for job, table in zip(jobs, tables, strict=True):
        ids = table["pair_id"].astype(str)
        table["key"] = [
            safe(one + (f" ({job.data.get('source', '')})" if several else "")) for one in ids
        ]
    baselines = list(dict.fromkeys(baseline for job in jobs for baseline in job.baselines()))
    keys = list(dict.fromkeys(key for table in tables for key in table["key"]))
    views = {_against(b): _per_driver_view(jobs, tables, keys, b) for b in baselines}
    return Plot(views, 460, "Improvement of every pair", _orders(jobs, tables, keys))


def _orders(
    jobs: Sequence[Job], tables: Sequence[pd.DataFrame], keys: Sequence[str]
) -> dict[str, list[str]]:
    """Returns the pairs in every order that a reader may choose, the improvement in the first job first."""
    orders: dict[str, list[str]] = {}
    for job, table in zip(jobs, tables, strict=True):
        for baseline in job.baselines():
            gains = dict(zip(table["key"], table[f"improvement/{baseline}"], strict=True))
            ranked = sorted(
                keys, key=lambda key: -gains[key] if np.isfinite(gains.get(key, np.nan)) else np.inf
            )
            orders[f"improvement over {baseline}, {job.name}"] = ranked
    every = pd.concat(tables).drop_duplicates("key").set_index("key")
    orders["driver"] = sorted(keys, key=lambda key: (_natural(str(every["driver"][key])), key))
    if "style_score" in every:
        orders["style score, conservative first"] = sorted(
            keys, key=lambda key: float(np.nan_to_num(every["style_score"][key]))
        )
    return orders


def _natural(name: str) -> list[tuple[int, str]]:
    """Orders "i80/9" before "i80/11"."""
    return [
        (int(part), "") if part.isdigit() else (-1, part)
        for part in re.split(r"(\d+)", name)
        if part
    ]


def _per_driver_view(
    jobs: Sequence[Job], tables: Sequence[pd.DataFrame], keys: Sequence[str], baseline: str
) -> dict[str, Any]:
    column = f"improvement/{baseline}"
    every = np.concatenate(
        [table[column].to_numpy(dtype=float) for table in tables if column in table]
        or [np.empty(0)]
    )
    low, note = cut(every, "improvements are lower (marked by a triangle; the mouse shows them)")
    data: list[Trace] = []
    for k, (job, table) in enumerate(zip(jobs, tables, strict=True)):
        if column in table:
            data += _per_driver_traces(job, table, baseline, low, k, bars=len(jobs) <= _BARS)
    undefined = int((~np.isfinite(every)).sum())
    if undefined:
        note = f"{note} {undefined} improvements are not defined and not shown.".strip()
    ticks = [_tick(key, keys) for key in keys]
    high = max(float(finite(every).max(initial=0.1)), 0.1)
    layout = {
        "barmode": "group",
        "scattermode": "group" if len(jobs) <= _BARS else "overlay",
        "bargap": 0.25,
        "xaxis": axis(
            "pair of a leader and a follower",
            type="category",
            categoryorder="array",
            categoryarray=list(keys),
            tickmode="array",
            tickvals=list(keys) if len(keys) <= _NAMED else [],
            ticktext=ticks,
            tickangle=-90,
            tickfont={"size": 10},
            showgrid=False,
        ),
        "yaxis": improvement_axis(baseline, low, high),
        "shapes": [zero_line("y")],
        "hovermode": "closest",
    }
    return view(data, layout, note)


def _tick(key: str, keys: Sequence[str]) -> str:
    """Returns a name without what all names start with, its middle left out if it is long."""
    if len(keys) > 1:
        first, last = min(keys), max(keys)
        same = next(
            (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b),
            min(len(first), len(last)),
        )
        key = key[max(first.rfind(mark, 0, same) for mark in "_-/:.") + 1 :]
    plain = html.unescape(key)
    return safe(plain if len(plain) <= 18 else f"{plain[:9]}…{plain[-8:]}")


def _per_driver_traces(
    job: Job, table: pd.DataFrame, baseline: str, low: float, k: int, *, bars: bool
) -> list[Trace]:
    colour, symbol = job_style(k)
    gain = table[f"improvement/{baseline}"].to_numpy(dtype=float)
    hover = [_pair_hover(job, row, baseline) for _, row in table.iterrows()]
    shown = np.maximum(gain, low)
    common = {
        "x": table["key"].tolist(),
        "y": shown,
        "text": hover,
        "hovertemplate": "%{text}<extra></extra>",
    }
    name = {"name": safe(job.name), "legendgroup": str(k)}
    main: Trace = {
        "type": "bar",
        "marker": {"color": colour},
        "textposition": "none",
        "offsetgroup": str(k),
    }
    if not bars:
        main = {
            "type": "scatter",
            "mode": "markers",
            "marker": {"color": colour, "symbol": symbol, "size": 7},
        }
    traces = [main | common | name]
    lower = np.flatnonzero(gain < low)
    if len(lower):
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [common["x"][i] for i in lower],
                "y": shown[lower],
                "text": [hover[i] for i in lower],
                "hovertemplate": "%{text}<extra></extra>",
                "marker": {
                    "symbol": "triangle-down",
                    "size": 11,
                    "color": colour,
                    "line": {"color": "black", "width": 1},
                },
                "showlegend": False,
                **({"offsetgroup": str(k)} if bars else {}),
                **name,
            }
        )
    return traces


def _pair_hover(job: Job, row: pd.Series[Any], baseline: str) -> str:
    gain = float(row[f"improvement/{baseline}"])
    score = (
        f", style score {row['style_score']:.3f}"
        if np.isfinite(row.get("style_score", np.nan))
        else ""
    )
    lines = [
        f"<b>pair {safe(row['pair_id'])}</b>",
        f"driver {safe(row['driver'])}, {safe(row['cluster'])}{score}",
        f"{safe(job.name)}: {percent(gain, 1) if np.isfinite(gain) else 'not defined'} over {safe(baseline)}",
    ]
    for column, unit in (("rmse_speed", "m/s"), ("rmse_gap", "m")):
        values = ", ".join(
            f"{safe(method)} {row[f'{column}/{method}']:.3f}" for method in job.methods
        )
        lines.append(f"RMSE of {column.removeprefix('rmse_')} ({unit}): {values}")
    return "<br>".join(lines)


def per_cluster(series: Mapping[str, Mapping[str, pd.DataFrame]], baselines: Sequence[str]) -> Plot:
    """Distribution of the improvement by cluster: a box and its pairs for each series of jobs; a view per baseline.

    Args:
        series: by name and cluster, some rows of `Job.by_pair`.
        baselines: what the policy is compared with.
    """
    views = {_against(b): _per_cluster_view(series, b) for b in baselines}
    return Plot(views, 440, "Improvement by cluster of driving style")


def _per_cluster_view(
    series: Mapping[str, Mapping[str, pd.DataFrame]], baseline: str
) -> dict[str, Any]:
    column = f"improvement/{baseline}"
    data: list[Trace] = []
    for k, (name, by_cluster) in enumerate(series.items()):
        tables = [table for table in by_cluster.values() if column in table]
        if tables:
            data.append(_box(pd.concat(tables, ignore_index=True), column, name, k))
    values = np.concatenate([np.empty(0), *(trace["y"] for trace in data)])
    low, note = cut(values, "improvements are lower and not in view (drag the axis to see them)")
    high = max(float(finite(values).max(initial=0.1)), 0.1)
    present = [c for c in CLUSTERS if any(c in by_cluster for by_cluster in series.values())]
    layout = {
        "boxmode": "group",
        "xaxis": axis(
            type="category", categoryorder="array", categoryarray=present, showgrid=False
        ),
        "yaxis": improvement_axis(baseline, low, high),
        "shapes": [zero_line("y")],
    }
    return view(data, layout, note)


def _box(pairs: pd.DataFrame, column: str, name: str, k: int) -> Trace:
    colour, _ = job_style(k)
    gain = pairs[column].to_numpy(dtype=float)
    return {
        "type": "box",
        "x": pairs["cluster"].map(safe).tolist(),
        "y": gain,
        "name": safe(name),
        "offsetgroup": str(k),
        "boxpoints": "all",
        "jitter": 0.5,
        "pointpos": 0,
        "boxmean": True,
        "marker": {"color": colour, "size": 5, "opacity": 0.6},
        "line": {"color": colour, "width": 1.6},
        "text": [
            f"<b>pair {safe(one)}</b><br>{percent(g, 1)}"
            for one, g in zip(pairs["pair_id"], gain, strict=True)
        ],
        "hovertemplate": "%{text}<extra></extra>",
        "hoveron": "boxes+points",
    }
