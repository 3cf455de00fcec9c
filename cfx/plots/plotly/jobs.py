"""Several jobs beside each other: mean improvements, errors, clusters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.plots.choice.common import Array
from cfx.plots.choice.jobs import ClusterBoxes, ClusterGroup, ErrorDots, Overview, Statistics
from cfx.plots.look import colour_of
from cfx.plots.plotly.figure import (
    Trace,
    axis,
    improvement_axis,
    job_style,
    safe,
    safe_all,
    view,
    zero_line,
)
from cfx.plots.words import label, percent_or_undefined
from cfx.style.result import CLUSTERS


def overview_view(chosen: Overview) -> dict[str, Any]:
    """Mean improvement with its 95 % interval, trimmed mean and median: a line per job."""
    rows = chosen.rows
    places = np.arange(len(rows))[::-1]
    statistics = [(row.mean, row.low, row.high, row.trimmed_mean, row.median) for row in rows]
    mean, low, high, trimmed_mean, median = np.array(statistics).T
    common: Trace = {
        "type": "scatter",
        "mode": "markers",
        "y": places,
        "text": [_overview_hover(row) for row in rows],
        "hovertemplate": "%{text}<extra></extra>",
    }
    interval = {
        "type": "data",
        "symmetric": False,
        "array": np.nan_to_num(high - mean),
        "arrayminus": np.nan_to_num(mean - low),
        "thickness": 2,
        "width": 5,
    }
    means: Trace = {
        "x": mean,
        "name": "mean and its 95 % interval",
        "error_x": interval,
        "marker": {"size": 12, "color": colour_of(chosen.baseline)},
    }
    trimmed: Trace = {
        "x": trimmed_mean,
        "name": "trimmed mean",
        "marker": {"symbol": "diamond-open", "size": 11, "color": "black"},
    }
    medians: Trace = {
        "x": median,
        "name": "median",
        "marker": {"symbol": "line-ns-open", "size": 13, "color": "black"},
    }
    layout = {
        "xaxis": improvement_axis(chosen.axis, upright=False),
        "yaxis": _job_axis([row.job for row in rows], places, showgrid=False),
        "shapes": [zero_line("x")],
    }
    return view([common | means, common | trimmed, common | medians], layout, chosen.axis.note)


def errors_view(chosen: ErrorDots) -> dict[str, Any]:
    """Errors of each method: a line per job."""
    places = np.arange(len(chosen.jobs))[::-1]
    data: list[Trace] = []
    for method, values in chosen.values.items():
        size, symbol = (14, "diamond") if method == "policy" else (11, "circle")
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": safe(label(method)),
                "x": values,
                "y": places,
                "text": _error_hover(chosen, method, values),
                "hovertemplate": "%{text}<extra></extra>",
                "marker": {"size": size, "color": colour_of(method), "symbol": symbol},
            }
        )
    layout = {
        "xaxis": axis(chosen.title, range=[0, chosen.high]),
        "yaxis": _job_axis(chosen.jobs, places, showgrid=True),
        # Room for the tool bar above a legend of all methods.
        "margin": {"l": 64, "r": 16, "t": 52, "b": 48},
    }
    return view(data, layout, chosen.note)


def clusters_view(chosen: ClusterBoxes) -> dict[str, Any]:
    """Distribution of the improvement by cluster: a box and its pairs for each group of jobs."""
    data: list[Trace] = []
    present: set[str] = set()
    for k, group in enumerate(chosen.groups):
        data.append(_box(group, k))
        present |= set(group.clusters)
    order = [cluster for cluster in CLUSTERS if cluster in present]
    layout = {
        "boxmode": "group",
        "xaxis": axis(type="category", categoryorder="array", categoryarray=order, showgrid=False),
        "yaxis": improvement_axis(chosen.axis),
        "shapes": [zero_line("y")],
    }
    return view(data, layout, chosen.axis.note)


def _job_axis(jobs: Sequence[str], places: NDArray[np.int64], *, showgrid: bool) -> dict[str, Any]:
    return axis(
        tickvals=places,
        ticktext=safe_all(jobs),
        range=[-0.6, len(jobs) - 0.4],
        showgrid=showgrid,
        ticks="",
    )


def _overview_hover(row: Statistics) -> str:
    low, high = percent_or_undefined(row.low, 1), percent_or_undefined(row.high, 1)
    return "<br>".join(
        [
            f"<b>{safe(row.job)}</b>",
            f"mean {percent_or_undefined(row.mean, 1)}",
            f"95 % interval {low} to {high}",
            f"trimmed mean {percent_or_undefined(row.trimmed_mean, 1)}",
            f"median {percent_or_undefined(row.median, 1)}",
        ]
    )


def _error_hover(chosen: ErrorDots, method: str, values: Array) -> list[str]:
    texts = []
    for job, value in zip(chosen.jobs, values, strict=True):
        error = f"{safe(label(method))}: {value:.3f} {safe(chosen.unit)}"
        texts.append(f"<b>{safe(job)}</b><br>{error}")
    return texts


def _box(group: ClusterGroup, k: int) -> Trace:
    colour, _ = job_style(k)
    texts = []
    for pair, value in zip(group.pair_ids, group.values, strict=True):
        texts.append(f"<b>pair {safe(pair)}</b><br>{percent_or_undefined(value, 1)}")
    return {
        "type": "box",
        "x": safe_all(group.clusters),
        "y": group.values,
        "name": safe(group.name),
        "offsetgroup": str(k),
        "boxpoints": "all",
        "jitter": 0.5,
        "pointpos": 0,
        "boxmean": True,
        "marker": {"color": colour, "size": 5, "opacity": 0.6},
        "line": {"color": colour, "width": 1.6},
        "text": texts,
        "hovertemplate": "%{text}<extra></extra>",
        "hoveron": "boxes+points",
    }
