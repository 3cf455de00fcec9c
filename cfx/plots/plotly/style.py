"""Distribution of the style scores."""

from __future__ import annotations

from typing import Any

import numpy as np

from cfx.plots.choice.style import ClusterBars, StyleHistogram
from cfx.plots.look import INK
from cfx.plots.plotly.figure import Plot, Trace, axis, view


def style_plot(histogram: StyleHistogram) -> Plot:
    """Histogram of the style scores, coloured by cluster, with the cuts."""
    data = [_bars(histogram, cluster) for cluster in histogram.clusters]
    # Plotly would put its ticks in the middle of the bars.
    step = 0.1 if np.ptp(histogram.edges) > 0.5 else 0.05
    most = histogram.highest
    legend = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "traceorder": "normal"}
    layout = {
        "barmode": "stack",
        "xaxis": axis(histogram.title, tick0=0, dtick=step),
        "yaxis": axis("drivers", range=[0, 1.22 * most], tick0=0, dtick=max(1, most // 5)),
        "legend": legend,
        **_cuts(histogram),
    }
    return Plot({"": view(data, layout)}, 330, "Distribution of the style scores")


def _bars(histogram: StyleHistogram, cluster: ClusterBars) -> Trace:
    edges = histogram.edges
    hover = "%{y} drivers<br>score %{customdata[0]:.3f} to %{customdata[1]:.3f}<extra></extra>"
    return {
        "type": "bar",
        "x": (edges[:-1] + edges[1:]) / 2,
        "y": cluster.counts,
        "width": np.diff(edges),
        "marker": {"color": cluster.colour, "line": {"color": "white", "width": 1}},
        "name": cluster.label,
        "customdata": np.column_stack([edges[:-1], edges[1:]]),
        "hovertemplate": f"{cluster.name}: {hover}",
    }


def _cuts(histogram: StyleHistogram) -> dict[str, Any]:
    shapes, annotations = [], []
    for k, cut in enumerate(histogram.cuts):
        look = {"color": INK, "width": 1.4, "dash": "dash"}
        ends = {"x0": cut, "x1": cut, "y0": 0, "y1": 1, "yref": "paper"}
        shapes.append({"type": "line", "line": look, **ends})
        side, shift = ("right", -4) if k == 0 else ("left", 4)
        place = {"x": cut, "y": 1, "yref": "paper", "yanchor": "top", "showarrow": False}
        annotations.append({"text": f"{cut:.3f}", "xanchor": side, "xshift": shift, **place})
    return {"shapes": shapes, "annotations": annotations}
