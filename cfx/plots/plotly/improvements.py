"""Improvement of every pair, of all jobs beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cfx.plots.choice.improvements import ImprovementBars, ImprovementSeries
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
from cfx.plots.words import common_prefix, short

_NAMED = 90
"""Up to so many pairs carry their names under the axis."""

_BARS = 3
"""Up to so many jobs are drawn as bars beside each other, more as dots."""


def improvements_view(
    bars: ImprovementBars, pair_ids: Sequence[str], hover: Sequence[Mapping[str, str]]
) -> dict[str, Any]:
    """Returns the view of one baseline.

    Args:
        bars: of J jobs.
        pair_ids: all pairs, in the order of the axis.
        hover: of J jobs, by pair: what the mouse shows, as safe text.
    """
    as_bars = len(bars.series) <= _BARS
    data: list[Trace] = []
    for k, series in enumerate(bars.series):
        data += _traces(series, hover[k], k, as_bars=as_bars)
    named: list[str] = []
    if len(pair_ids) <= _NAMED:
        named = list(pair_ids)
    layout = {
        "barmode": "group",
        "scattermode": "group" if as_bars else "overlay",
        "bargap": 0.25,
        "xaxis": axis(
            "pair of a leader and a follower",
            type="category",
            categoryorder="array",
            categoryarray=safe_all(pair_ids),
            tickmode="array",
            tickvals=safe_all(named),
            ticktext=_tick_names(named),
            tickangle=-90,
            tickfont={"size": 10},
            showgrid=False,
        ),
        "yaxis": improvement_axis(bars.axis),
        "shapes": [zero_line("y")],
        "hovermode": "closest",
    }
    return view(data, layout, bars.axis.note)


def _tick_names(pair_ids: list[str]) -> list[str]:
    """Returns names without what all names start with, their middle left out if they are long."""
    prefix = common_prefix(pair_ids)
    return [safe(short(name.removeprefix(prefix), 18)) for name in pair_ids]


def _traces(
    series: ImprovementSeries, hover: Mapping[str, str], k: int, *, as_bars: bool
) -> list[Trace]:
    colour, symbol = job_style(k)
    places = safe_all(series.pair_ids)
    texts = [hover[pair] for pair in series.pair_ids]
    common: Trace = {
        "name": safe(series.name),
        "legendgroup": str(k),
        "hovertemplate": "%{text}<extra></extra>",
    }
    if as_bars:
        marker: dict[str, Any] = {"color": colour}
        look: Trace = {"type": "bar", "textposition": "none", "offsetgroup": str(k)}
    else:
        marker = {"color": colour, "symbol": symbol, "size": 7}
        look = {"type": "scatter", "mode": "markers"}
    data = {"x": places, "y": series.shown, "text": texts, "marker": marker}
    traces = [common | look | data]
    cut = np.flatnonzero(series.clipped)
    if len(cut):
        traces.append(common | _arrows(places, texts, series, colour))
        if as_bars:
            traces[-1]["offsetgroup"] = str(k)
    return traces


def _arrows(places: list[str], texts: list[str], series: ImprovementSeries, colour: str) -> Trace:
    """Returns a triangle at the end of each bar that is cut off."""
    cut = np.flatnonzero(series.clipped)
    outline = {"color": "black", "width": 1}
    return {
        "type": "scatter",
        "mode": "markers",
        "x": [places[index] for index in cut],
        "y": series.shown[cut],
        "text": [texts[index] for index in cut],
        "marker": {"symbol": "triangle-down", "size": 11, "color": colour, "line": outline},
        "cliponaxis": False,
        "showlegend": False,
    }
