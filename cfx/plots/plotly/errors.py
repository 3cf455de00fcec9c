"""Errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cfx.plots.choice.errors import TIME_TITLE, ErrorPanel
from cfx.plots.look import EDGE
from cfx.plots.plotly.figure import Plot, Trace, axes_number, axis, view
from cfx.plots.plotly.trajectories import line_trace

_HALVES = ([0.0, 0.455], [0.545, 1.0])


def errors_plot(panels: Sequence[ErrorPanel]) -> Plot:
    """RMSE of speed and of gap over all pairs at each moment since the test part began."""
    data: list[Trace] = []
    layout: dict[str, Any] = {"hovermode": "x", "shapes": []}
    for k, panel in enumerate(panels):
        number = axes_number(k)
        layout[f"xaxis{number}"] = axis(TIME_TITLE, domain=_HALVES[k], anchor=f"y{number}")
        layout[f"yaxis{number}"] = axis(panel.title, anchor=f"x{number}", rangemode="tozero")
        for line in panel.lines:
            data.append(line_trace(line, number, legend=k == 0))
        if panel.shows_transient:
            place = {"x0": panel.transient_s, "x1": panel.transient_s, "y0": 0, "y1": 1}
            references = {"xref": f"x{number}", "yref": f"y{number} domain", "layer": "below"}
            look = {"type": "line", "line": {"color": EDGE, "width": 1, "dash": "dash"}}
            layout["shapes"].append(look | references | place)
    return Plot({"": view(data, layout)}, 340, "Errors over all pairs since the test part began")
