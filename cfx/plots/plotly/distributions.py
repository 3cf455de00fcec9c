"""Sampled forecasts as distributions."""

from __future__ import annotations

from typing import Any

import numpy as np

from cfx.evaluation.distributions import LEVEL
from cfx.plots.choice.distributions import PIT_TITLE, DistributionView
from cfx.plots.choice.forecasts import HORIZON_TITLE
from cfx.plots.choice.trajectories import Line
from cfx.plots.look import EDGE
from cfx.plots.plotly.figure import Plot, Trace, axis, view
from cfx.plots.plotly.trajectories import line_trace

_DOMAINS = ([0.0, 0.27], [0.37, 0.64], [0.74, 1.0])


def distributions_plot(shown: DistributionView) -> Plot:
    """CRPS and coverage against the horizon, and the PIT of one horizon."""
    crps, coverage = shown.crps, shown.coverage
    data: list[Trace] = []
    for line in crps.lines:
        data.append(line_trace(line) | {"mode": "lines+markers"})
    for line in coverage.lines:
        data.append(line_trace(line, "2", legend=False) | {"mode": "lines+markers"})
    for histogram in shown.pit:
        edges = np.linspace(0.0, 1.0, len(histogram.density) + 1)
        heights = np.append(histogram.density, histogram.density[-1])
        steps = Line(histogram.method, edges, heights, steps=True)
        data.append(line_trace(steps, "3", legend=False))
    layout: dict[str, Any] = {
        "hovermode": "closest",
        "xaxis": axis(HORIZON_TITLE, domain=_DOMAINS[0]),
        "yaxis": axis(crps.title, type="log", dtick="D2"),
        "xaxis2": axis(HORIZON_TITLE, domain=_DOMAINS[1], anchor="y2"),
        "yaxis2": axis(coverage.title, range=[0, 1], anchor="x2"),
        "xaxis3": axis(PIT_TITLE, domain=_DOMAINS[2], anchor="y3", range=[0, 1]),
        "yaxis3": axis(f"density, {shown.horizon:g} s ahead", anchor="x3", rangemode="tozero"),
        "shapes": [_level(LEVEL, "2"), _level(1.0, "3")],
    }
    return Plot({"": view(data, layout)}, 400, "CRPS, coverage and PIT of sampled forecasts")


def _level(value: float, number: str) -> dict[str, Any]:
    return {
        "type": "line",
        "xref": f"x{number} domain",
        "yref": f"y{number}",
        "x0": 0,
        "x1": 1,
        "y0": value,
        "y1": value,
        "line": {"color": EDGE, "width": 1},
        "layer": "below",
    }
