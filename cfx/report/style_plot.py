"""Plot of the style scores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cfx.figures.look import CLUSTER_COLOURS, INK
from cfx.report.figure import Array, Plot, Trace, axis, view
from cfx.report.read import finite
from cfx.style.result import CLUSTERS

_CLUSTERS = dict(zip(CLUSTERS, CLUSTER_COLOURS, strict=True))


def style(table: pd.DataFrame, percentiles: Sequence[float]) -> Plot:
    """Histogram of the style scores, coloured by cluster, with the cuts.

    Args:
        table: a row per driver: score, cluster (0, 1, 2).
        percentiles: of the scores, where the clusters are cut.
    """
    scores, cluster = (
        table["score"].to_numpy(dtype=float),
        table["cluster"].astype(float).astype(int).to_numpy(),
    )
    known = finite(scores)
    bins = int(np.clip(2 * np.sqrt(len(known)), 8, 24))
    edges = np.histogram_bin_edges(known if len(known) else np.array([0.0, 1.0]), bins)
    centres, width = (edges[:-1] + edges[1:]) / 2, float(edges[1] - edges[0])
    most = int(np.histogram(known, edges)[0].max())
    data: list[Trace] = []
    for index, name in enumerate(CLUSTERS):
        mine = finite(scores[cluster == index])
        data.append(
            {
                "type": "bar",
                "x": centres,
                "y": np.histogram(mine, edges)[0],
                "width": width,
                "marker": {"color": _CLUSTERS[name], "line": {"color": "white", "width": 1}},
                "name": f"{name}: {len(mine)}",
                "customdata": np.column_stack([edges[:-1], edges[1:]]),
                "hovertemplate": f"{name}: %{{y}} drivers<br>score %{{customdata[0]:.3f}} to %{{customdata[1]:.3f}}"
                "<extra></extra>",
            }
        )
    layout = {
        "barmode": "stack",
        # Plotly would put its ticks in the middle of the bars.
        "xaxis": axis(
            "style score (0 conservative, 1 aggressive)",
            tick0=0,
            dtick=0.1 if np.ptp(edges) > 0.5 else 0.05,
        ),
        "yaxis": axis("drivers", range=[0, 1.15 * max(most, 1)], tick0=0, dtick=max(1, most // 5)),
        "legend": {
            "orientation": "h",
            "x": 0,
            "y": 1.0,
            "yanchor": "bottom",
            "traceorder": "normal",
        },
        **_cuts(np.percentile(known, list(percentiles)) if len(known) else np.empty(0)),
    }
    return Plot({"": view(data, layout)}, 330, "Distribution of the style scores")


def _cuts(cuts: Array) -> dict[str, Any]:
    line = {
        "type": "line",
        "y0": 0,
        "y1": 1,
        "yref": "paper",
        "line": {"color": INK, "width": 1.4, "dash": "dash"},
    }
    text = {"y": 1, "yref": "paper", "showarrow": False, "yanchor": "top"}
    sides = zip(cuts, ("right", "left"), (-4, 4), strict=False)
    return {
        "shapes": [line | {"x0": cut, "x1": cut} for cut in cuts],
        "annotations": [
            text | {"x": cut, "text": f"{cut:.3f}", "xanchor": side, "xshift": shift}
            for cut, side, shift in sides
        ],
    }
