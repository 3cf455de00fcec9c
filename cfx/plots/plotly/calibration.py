"""Calibrated parameters between their bounds, and their correlations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cfx.plots.choice.calibration import ParameterSpread, spread_offsets
from cfx.plots.choice.common import Array
from cfx.plots.look import colour_of
from cfx.plots.plotly.figure import Plot, Trace, axis, safe_all, view
from cfx.plots.words import label, number, unit_label

_WIDTH = 0.3
"""Of a line of dots, half of it; lines are 1 apart."""


def calibration_plot(spreads: Sequence[ParameterSpread], table: pd.DataFrame) -> Plot:
    """A line of dots for each parameter; as a second view the rank correlations.

    Args:
        spreads: of at least one parameter.
        table: as `correlations` returns it.
    """
    views = {"values between the bounds": _values(spreads)}
    if len(table) > 1:
        views["rank correlation"] = _correlations(table)
    height = 150 + 34 * len(spreads)
    return Plot(views, height, "Calibrated parameters of all drivers", chooser="Show")


def _values(spreads: Sequence[ParameterSpread]) -> dict[str, Any]:
    rows = np.arange(len(spreads), dtype=np.float64)[::-1]
    data = []
    for method, size, symbol in (("fixed", 6, "circle"), ("population", 11, "diamond")):
        data.append(_dots(spreads, rows, method, size, symbol))
    data.append(_dots(spreads, rows, "default", 15, "line-ns-open"))
    data = [trace for trace in data if len(trace["x"])]
    names = safe_all(unit_label(spread.axis.name, spread.axis.unit) for spread in spreads)
    bounds = []
    for row in rows:
        for x in (0, 1):
            ends = {"x0": x, "x1": x, "y0": row - 0.4, "y1": row + 0.4}
            bounds.append({"type": "line", "line": {"color": "#808080", "width": 1}, **ends})
    title = "place between the parameter's bounds"
    layout = {
        "xaxis": axis(title, tickformat=".0%", range=[-0.04, 1.04]),
        "yaxis": axis(
            tickvals=rows, ticktext=names, range=[-0.6, len(spreads) - 0.4], showgrid=False
        ),
        "shapes": bounds,
    }
    return view(data, layout)


def _dots(
    spreads: Sequence[ParameterSpread], rows: Array, method: str, size: int, symbol: str
) -> Trace:
    x, y, hover = [], [], []
    for spread, row in zip(spreads, rows, strict=True):
        values = {
            "fixed": spread.values,
            "population": spread.pooled,
            "default": np.array([spread.default]),
        }[method]
        offsets = np.zeros(len(values))
        if method == "fixed":
            offsets = _WIDTH * spread_offsets(len(values))
        x.append(spread.places(values))
        y.append(row + offsets)
        unit = "" if spread.axis.unit in {"", "1"} else f" {spread.axis.unit}"
        for value in values:
            hover.append(f"{spread.axis.name} {number(value)}{unit}")
    return {
        "type": "scatter",
        "mode": "markers",
        "name": label(method),
        "x": np.concatenate(x),
        "y": np.concatenate(y),
        "text": safe_all(hover),
        "hovertemplate": "%{text}<extra></extra>",
        "marker": {
            "size": size,
            "symbol": symbol,
            "color": colour_of(method),
            "opacity": 0.6 if method == "fixed" else 1.0,
            "line": {"width": 0 if method == "fixed" else 2, "color": colour_of(method)},
        },
    }


def _correlations(table: pd.DataFrame) -> dict[str, Any]:
    names = safe_all(table.columns)
    values = table.to_numpy(dtype=float)
    texts = np.full(values.shape, "", dtype=object)
    for place, value in np.ndenumerate(values):
        if np.isfinite(value):
            texts[place] = f"{value:.2f}"
    data = [
        {
            "type": "heatmap",
            "x": names,
            "y": names,
            "z": values,
            "zmin": -1,
            "zmax": 1,
            "colorscale": "RdBu",
            "reversescale": True,
            "text": texts.tolist(),
            "texttemplate": "%{text}",
            "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
        }
    ]
    layout = {"xaxis": axis(showgrid=False), "yaxis": axis(autorange="reversed", showgrid=False)}
    return view(data, layout)
