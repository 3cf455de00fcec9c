"""Plot of the learning curves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from cfx.figures.look import TRAIN_COLOUR, VALIDATION_COLOUR
from cfx.learners.curves import over_networks
from cfx.report.figure import Array, Plot, Trace, axis, view

_CURVE_POINTS = 250


def learning(curves: pd.DataFrame) -> Plot:
    """Loss by epoch: mean over the networks and the band from the 10th to the 90th percentile."""
    data: list[Trace] = []
    for column, name, colour, dash in (
        ("train_loss", "training", TRAIN_COLOUR, "solid"),
        ("validation_loss", "validation", VALIDATION_COLOUR, "dash"),
    ):
        losses = over_networks(curves, column)
        if not losses.empty:
            kept = np.unique(
                np.linspace(0, len(losses) - 1, min(_CURVE_POINTS, len(losses))).round().astype(int)
            )
            data += _loss_traces(losses.iloc[kept], name, colour, dash)
    values = np.concatenate([np.empty(0), *(trace["y"] for trace in data)])
    layout = {"xaxis": axis("epoch"), "yaxis": _loss_axis(values), "hovermode": "x unified"}
    return Plot({"": view(data, layout)}, 320, "Learning curves")


def _loss_traces(losses: pd.DataFrame, name: str, colour: str, dash: str) -> list[Trace]:
    epoch = losses.index.to_numpy(dtype=float)
    common: Trace = {"type": "scatter", "x": epoch, "legendgroup": name}
    mean = common | {
        "mode": "lines" if len(epoch) > 2 else "lines+markers",
        "y": losses.mean(axis=1).to_numpy(),
        "name": name,
        "line": {"color": colour, "width": 2.4, "dash": dash},
        "hovertemplate": f"{name}, epoch %{{x}}: %{{y:.4g}}<extra></extra>",
    }
    if losses.shape[1] == 1:
        return [mean]
    low, high = (losses.quantile(q, axis=1).to_numpy() for q in (0.1, 0.9))
    band = common | {
        "mode": "lines",
        "line": {"width": 0},
        "hoverinfo": "skip",
        "showlegend": False,
    }
    return [
        band | {"y": low},
        band | {"y": high, "fill": "tonexty", "fillcolor": _faint(colour)},
        mean,
    ]


def _loss_axis(values: Array) -> dict[str, Any]:
    """Returns a logarithmic axis where all losses are positive and span more than a factor of five."""
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    if not (low > 0 and high > 5 * low):
        return axis("loss")
    digits = (1, 2, 5) if high < 1e3 * low else (1,)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [digit * 10.0**power for power in powers for digit in digits]
    return axis(
        "loss, logarithmic",
        type="log",
        tickmode="array",
        tickvals=ticks,
        ticktext=[f"{tick:.2g}" for tick in ticks],
    )


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.22)"
