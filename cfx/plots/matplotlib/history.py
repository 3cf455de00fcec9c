"""Improvement by the amount of burn-in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.plots.choice.history import AMOUNT_TITLE, SUBTITLE, HistoryCurve
from cfx.plots.choice.improvements import improvement_title
from cfx.plots.look import INK
from cfx.plots.matplotlib.canvas import canvas, percent_axis, styled


@styled
def draw_history(curves: Sequence[HistoryCurve], amounts: Sequence[str]) -> Figure:
    """Draws the mean improvement and its 95 % interval against the amount of burn-in.

    Args:
        curves: one for each base.
        amounts: all of them, in their order.
    """
    figure = canvas(3.9)
    axes = figure.subplots()
    for k, curve in enumerate(curves):
        aside = 0.06 * (k - 0.5 * (len(curves) - 1))
        places = np.array([amounts.index(amount) for amount in curve.amounts]) + aside
        interval = np.nan_to_num(np.stack([curve.mean - curve.low, curve.high - curve.mean]))
        axes.errorbar(
            places,
            curve.mean,
            interval,
            color=curve.colour,
            marker="o",
            linewidth=1.8,
            capsize=4,
            label=curve.label,
        )
    axes.axhline(0, color=INK, linewidth=0.9)
    axes.set_xticks(range(len(amounts)), amounts)
    axes.set_xlim(-0.4, len(amounts) - 0.6)
    axes.set_xlabel(AMOUNT_TITLE)
    axes.set_ylabel(improvement_title("fixed").replace(" over ", "\nover ") + " (%)")
    percent_axis(axes)
    figure.legend(loc="outside upper center", ncols=2, title=SUBTITLE, title_fontsize=10.5)
    return figure
