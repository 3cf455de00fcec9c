"""Traffic of sampled drivers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cfx.plots.choice.traffic import TrafficPanel
from cfx.plots.look import BAND, EDGE
from cfx.plots.plotly.figure import Plot, Trace, axes_number, axis, view
from cfx.plots.plotly.trajectories import line_trace

_COLUMNS = 2
_APART, _BELOW = 0.1, 0.16
"""Shares of the width and of the height between two panels."""


def traffic_plot(panels: Sequence[TrafficPanel]) -> Plot:
    """Flow, variation, waves and growth, two panels beside each other."""
    data: list[Trace] = []
    layout: dict[str, Any] = {"hovermode": "closest", "shapes": []}
    rows = -(-len(panels) // _COLUMNS)
    named: set[str] = set()
    for k, panel in enumerate(panels):
        number = axes_number(k)
        across = _domain(k % _COLUMNS, _COLUMNS, _APART)
        down = _domain(rows - 1 - k // _COLUMNS, rows, _BELOW)
        scale: dict[str, Any] = {"rangemode": "tozero"}
        if panel.limits is not None:
            scale = {"range": list(panel.limits)}
        if panel.band is not None:
            layout["shapes"].append(_band(panel.band, number))
        layout[f"xaxis{number}"] = axis(panel.against, domain=across, anchor=f"y{number}")
        layout[f"yaxis{number}"] = axis(panel.title, domain=down, anchor=f"x{number}", **scale)
        if len(panel.cloud[0]):
            data.append(_cloud(panel, number))
        for line in panel.lines:
            data.append(line_trace(line, number, legend=line.method not in named))
            named.add(line.method)
    return Plot({"": view(data, layout)}, 330 * rows, "Traffic of sampled drivers")


def _domain(place: int, places: int, apart: float) -> list[float]:
    width = (1.0 - apart * (places - 1)) / places
    begin = place * (width + apart)
    return [begin, min(1.0, begin + width)]


def _band(band: tuple[float, float], number: str) -> dict[str, Any]:
    return {
        "type": "rect",
        "xref": f"x{number} domain",
        "yref": f"y{number}",
        "x0": 0,
        "x1": 1,
        "y0": band[0],
        "y1": band[1],
        "fillcolor": BAND,
        "line": {"width": 0},
        "layer": "below",
    }


def _cloud(panel: TrafficPanel, number: str) -> Trace:
    x, y = panel.cloud
    return {
        "type": "scatter",
        "mode": "markers",
        "x": np.round(x, 1),
        "y": np.round(y, 0),
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
        "marker": {"size": 3, "color": EDGE, "opacity": 0.3},
        "showlegend": False,
        "hoverinfo": "skip",
    }
