"""Platoons behind a braking leader."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cfx.plots.choice.platoon import TIME_TITLE, PlatoonPanel, VehicleLine, speed_range
from cfx.plots.look import COLLISION_COLOUR
from cfx.plots.plotly.figure import Plot, Trace, axes_number, axis, heading, safe, safe_all, view


def platoon_plot(panels: Sequence[PlatoonPanel]) -> Plot:
    """Speeds over time, a panel per method."""
    data: list[Trace] = []
    layout: dict[str, Any] = {
        "annotations": [],
        "margin": {"l": 56, "r": 12, "t": 74, "b": 62},
        "showlegend": False,
    }
    ends = list(speed_range(panels))
    for k, panel in enumerate(panels):
        number = axes_number(k)
        left, title = 0.0, "speed (m/s)"
        shared_x, shared_y = None, None
        if k:
            left, title = (k + 0.06) / len(panels), ""
            shared_x, shared_y = "x", "y"
        domain = [left, (k + 0.96) / len(panels)]
        layout[f"xaxis{number}"] = axis(domain=domain, anchor=f"y{number}", matches=shared_x)
        layout[f"yaxis{number}"] = axis(title, anchor=f"x{number}", matches=shared_y, range=ends)
        above = heading(safe(panel.title), left, 1.02, size=11)
        above["text"] = "<br>".join([above["text"], *safe_all(panel.verdicts)])
        layout["annotations"].append(above | {"align": "left"})
        # The leader is drawn last, above its followers.
        for line in [*panel.lines[1:], panel.lines[0]]:
            data += _traces(line, number)
    place = {"x": 0.5, "y": 0, "yshift": -46, "xref": "paper", "yref": "paper"}
    layout["annotations"].append({"text": TIME_TITLE, "showarrow": False, **place})
    return Plot({"": view(data, layout)}, 390, "Speeds of ten followers behind a braking leader")


def _traces(line: VehicleLine, number: str) -> list[Trace]:
    axes: Trace = {
        "type": "scatter",
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
        "name": line.name,
    }
    speeds: Trace = {
        "mode": "lines",
        "x": np.round(line.time, 2),
        "y": np.round(line.speed, 2),
        "line": {"width": 2.4 if line.vehicle == 0 else 1.4, "color": line.colour},
        "hovertemplate": f"{line.name}: %{{y:.2f}} m/s at %{{x:.1f}} s<extra></extra>",
    }
    if line.collision is None:
        return [axes | speeds]
    mark: Trace = {
        "mode": "markers",
        "x": [line.collision[0]],
        "y": [line.collision[1]],
        "marker": {"symbol": "x", "size": 8, "color": COLLISION_COLOUR},
        "hovertemplate": f"{line.name} collides<extra></extra>",
    }
    return [axes | speeds, axes | mark]
