"""Calibrated parameters between their bounds, and their correlations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from cfx.plots.choice.calibration import ParameterSpread, spread_offsets
from cfx.plots.look import EDGE, INK, colour_of
from cfx.plots.matplotlib.canvas import canvas, styled
from cfx.plots.words import label, number, percent, unit_label

_WIDTH = 0.3
"""Of a line of dots, half of it; lines are 1 apart."""


@styled
def draw_calibration(spreads: Sequence[ParameterSpread], table: pd.DataFrame) -> Figure:
    """Draws each parameter's calibrated values between its bounds; beside it their correlations.

    Args:
        spreads: of at least one parameter.
        table: as `correlations` returns it.
    """
    figure = canvas(1.7 + 0.42 * max(len(spreads), 4))
    left, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    _values(left, spreads)
    _correlations(right, table)
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside upper center", ncols=3, handlelength=1.2
    )
    return figure


def _values(axes: Axes, spreads: Sequence[ParameterSpread]) -> None:
    rows = np.arange(len(spreads), dtype=float)
    for row, spread in zip(rows, spreads, strict=True):
        axes.vlines((0, 1), row - 0.42, row + 0.42, color=EDGE, linewidth=1)
        places = spread.places(spread.values)
        named = {method: label(method) if row == 0 else "" for method in ("fixed", "default")}
        axes.plot(
            places,
            row + _WIDTH * spread_offsets(len(places)),
            linestyle="none",
            marker="o",
            markersize=3.2,
            alpha=0.55,
            color=colour_of("fixed"),
            markeredgewidth=0,
            label=named["fixed"],
        )
        pooled = spread.places(spread.pooled)
        axes.plot(
            pooled,
            np.full(len(pooled), row),
            linestyle="none",
            marker="D",
            markersize=6,
            color=colour_of("population"),
            label=label("population") if row == 0 and len(pooled) else "",
        )
        axes.plot(
            spread.places(np.array([spread.default])),
            [row],
            linestyle="none",
            marker="|",
            markersize=17,
            markeredgewidth=2.2,
            color=colour_of("default"),
            label=named["default"],
        )
        _ends(axes, spread, row)
    names = [unit_label(spread.axis.name, spread.axis.unit) for spread in spreads]
    axes.set_yticks(rows, names)
    axes.set_ylim(len(spreads) - 0.4, -0.6)
    axes.set_xlim(-0.16, 1.16)
    axes.set_xticks((0, 0.25, 0.5, 0.75, 1.0))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(
        "place between the bounds; at the ends: the bound, and the share of pairs at it"
    )


def _ends(axes: Axes, spread: ParameterSpread, row: float) -> None:
    for place, bound, share, side in (
        (-0.02, spread.axis.low, spread.at_low, "right"),
        (1.02, spread.axis.high, spread.at_high, "left"),
    ):
        assert bound is not None
        text = number(bound)
        if share > 0:
            text += f"\n{percent(share).lstrip('+')}"
        axes.text(place, row, text, ha=side, va="center", fontsize=8.5, color=INK)


def _correlations(axes: Axes, table: pd.DataFrame) -> None:
    values = table.to_numpy(dtype=float)
    axes.imshow(values, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    places = np.arange(len(table))
    axes.set_xticks(places, list(table.columns), rotation=90)
    axes.set_yticks(places, list(table.columns))
    axes.grid(visible=False)
    axes.tick_params(length=0)
    if len(table) <= 7:
        for row, column in np.argwhere(np.isfinite(values)):
            value = values[row, column]
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(column, row, f"{value:.1f}", ha="center", va="center", color=colour, size=9)
    axes.set_title("rank correlation over drivers")
