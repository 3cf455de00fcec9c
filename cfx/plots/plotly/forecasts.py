"""Errors of forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cfx.plots.choice.forecasts import ForecastPanel
from cfx.plots.plotly.figure import Plot, Trace, axes_number, axis, view
from cfx.plots.plotly.trajectories import line_trace

_APART = 0.09
"""Share of the width between two panels."""


def forecasts_plot(panels: Sequence[ForecastPanel], against: str) -> Plot:
    """Mean errors over drivers, a panel for each error.

    Args:
        panels: the panels, side by side.
        against: title of the horizontal axes.
    """
    data: list[Trace] = []
    layout: dict[str, Any] = {"hovermode": "x"}
    width = (1.0 - _APART * (len(panels) - 1)) / len(panels)
    for k, panel in enumerate(panels):
        number = axes_number(k)
        left = k * (width + _APART)
        across = [left, min(1.0, left + width)]
        scale: dict[str, Any] = {"rangemode": "tozero"}
        if panel.logarithmic:
            scale = {"type": "log", "dtick": "D2"}
        layout[f"xaxis{number}"] = axis(against, domain=across, anchor=f"y{number}")
        layout[f"yaxis{number}"] = axis(panel.title, anchor=f"x{number}", **scale)
        for line in panel.lines:
            trace = line_trace(line, number, legend=k == 0)
            data.append(trace | {"mode": "lines+markers"})
    return Plot({"": view(data, layout)}, 400, f"Errors of forecasts against {against}")
