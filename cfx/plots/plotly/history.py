"""Improvement by the amount of burn-in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfx.plots.choice.history import AMOUNT_TITLE, HistoryCurve
from cfx.plots.choice.improvements import improvement_title
from cfx.plots.plotly.figure import Plot, Trace, axis, safe, safe_all, view, zero_line
from cfx.plots.words import percent_or_undefined


def history_plot(curves: Sequence[HistoryCurve], amounts: Sequence[str]) -> Plot:
    """Mean improvement and its 95 % interval against the amount of burn-in.

    Args:
        curves: one for each base.
        amounts: all of them, in their order.
    """
    data = [_trace(curve) for curve in curves]
    x_axis = axis(
        AMOUNT_TITLE,
        type="category",
        categoryorder="array",
        categoryarray=safe_all(amounts),
    )
    title = improvement_title("fixed").replace(" over ", "<br>over ")
    y_axis = axis(title, tickformat=".0%")
    layout = {"xaxis": x_axis, "yaxis": y_axis, "shapes": [zero_line("y")]}
    return Plot({"": view(data, layout)}, 360, "Improvement by the amount of burn-in")


def _trace(curve: HistoryCurve) -> Trace:
    name = safe(curve.label)
    interval = {
        "type": "data",
        "symmetric": False,
        "array": np.nan_to_num(curve.high - curve.mean),
        "arrayminus": np.nan_to_num(curve.mean - curve.low),
        "width": 5,
    }
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": safe_all(curve.amounts),
        "y": curve.mean,
        "error_y": interval,
        "marker": {"size": 9, "color": curve.colour},
        "line": {"color": curve.colour, "width": 2},
        "text": _hover(curve),
        "hovertemplate": f"{name}<br>%{{text}}<extra></extra>",
    }


def _hover(curve: HistoryCurve) -> list[str]:
    texts = []
    for k, amount in enumerate(curve.amounts):
        mean = percent_or_undefined(float(curve.mean[k]), 1)
        low = percent_or_undefined(float(curve.low[k]), 1)
        high = percent_or_undefined(float(curve.high[k]), 1)
        texts.append(f"{safe(amount)}: {mean}, 95 % interval {low} to {high}")
    return texts
