"""Improvement of the policy, pair by pair."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from cfx.plots.choice.improvements import ImprovementBars, ImprovementSeries
from cfx.plots.look import COLOURS, INK
from cfx.plots.matplotlib.canvas import Dash, canvas, percent_axis, say, styled
from cfx.plots.words import (
    common_prefix,
    label,
    percent,
    percent_or_undefined,
    plural,
    short,
)

if TYPE_CHECKING:
    from cfx.evaluation.statistics import Improvement

_NAMED = 40
"""Up to so many bars carry their pair's name."""

_LABELLED = 8
"""Up to so many bars that are cut off carry their value; of more, only the worst."""


@styled
def draw_improvements(bars: ImprovementBars, summary: Improvement) -> Figure:
    """Draws sorted bars of every pair's improvement with mean, 95 % interval, trimmed mean, median.

    A bar has the colour of the method that was closer to the driver. Bars that are cut off end in
    an arrow with the value. Pairs without a defined improvement are counted in the axis label.

    Args:
        bars: of one job.
        summary: statistics over the pairs.
    """
    (series,) = bars.series
    named = len(series.pair_ids) <= _NAMED
    prefix = common_prefix(list(series.pair_ids))
    ticks = []
    for name in series.pair_ids:
        ticks.append(short(name.removeprefix(prefix), 16))
    longest = max(map(len, ticks), default=0) if named else 0
    figure = canvas(4.3 + 0.075 * longest)
    axes = figure.subplots()
    axes.set_ylim(bars.axis.low, bars.axis.high)
    _bars(axes, series, bars.axis.low)
    handles = _closer(series) + _statistics(axes, summary, bars.axis.low)
    # A few bars stand in the middle, and no broader than those of a larger job.
    count = len(series.values)
    middle, half = (count - 1) / 2, max(count, 8) / 2 + 0.3
    axes.set_xlim(middle - half, middle + half)
    axes.grid(visible=False, axis="x")
    percent_axis(axes)
    axes.set_ylabel(bars.axis.title.replace(" over ", "\nover ") + " (%)")
    if named:
        axes.set_xticks(np.arange(count), ticks, rotation=90, fontsize=8.5)
        axes.tick_params(axis="x", length=0)
    else:
        axes.set_xticks([])
    axes.set_xlabel(_pairs_title(bars, prefix if named else ""))
    if not count:
        say(axes, "no pair has a defined improvement")
    figure.legend(
        handles=handles, loc="outside upper center", ncols=3, columnspacing=1.8, handlelength=1.8
    )
    return figure


def _bars(axes: Axes, series: ImprovementSeries, low: float) -> None:
    places = np.arange(len(series.values))
    colours = np.where(series.values > 0, COLOURS["policy"], COLOURS["fixed"]).tolist()
    axes.bar(places, series.shown, width=0.82, color=colours)
    axes.axhline(0, color=INK, linewidth=0.9)
    cut = np.flatnonzero(series.clipped)
    arrow = low + 0.035 * (axes.get_ylim()[1] - low)
    for index in cut:
        axes.plot(places[index], arrow, marker="v", color="white", markersize=5, zorder=4)
        if len(cut) <= _LABELLED or index == cut[-1]:
            axes.annotate(
                percent(float(series.values[index])),
                (float(places[index]), low),
                (0, 14),
                textcoords="offset points",
                ha="center",
                va="bottom",
                rotation=90,
                color="white",
                fontsize=9,
                fontweight="bold",
                zorder=5,
            )


def _closer(series: ImprovementSeries) -> list[Line2D | Patch]:
    policy = int((series.values > 0).sum())
    others = len(series.values) - policy
    return [
        Patch(color=COLOURS["policy"], label=f"policy closer to the driver: {policy}"),
        Patch(color=COLOURS["fixed"], label=f"{label('fixed')} closer, or equal: {others}"),
    ]


def _statistics(axes: Axes, summary: Improvement, low: float) -> list[Line2D | Patch]:
    """Draws the summary's lines and returns their legend entries, which carry the numbers."""
    handles: list[Line2D | Patch] = []
    ends = (summary.ci95_low, summary.ci95_high)
    if np.isfinite(ends).all():
        axes.axhspan(*ends, color="#000000", alpha=0.13, linewidth=0, zorder=0.5)
        text = f"95 % interval of the mean: {percent(ends[0], 1)} to {percent(ends[1], 1)}"
        handles.append(Patch(color="#000000", alpha=0.13, label=text))
    lines: tuple[tuple[str, float, Dash, float], ...] = (
        ("mean", summary.mean, "solid", 1.8),
        ("trimmed mean", summary.trimmed_mean, (0, (5, 1.8)), 1.4),
        ("median", summary.median, (0, (1.2, 1.4)), 1.6),
    )
    for name, value, dash, width in lines:
        text = f"{name} {percent_or_undefined(value, 1)}"
        if np.isfinite(value):
            axes.axhline(value, color="black", linestyle=dash, linewidth=width, zorder=3)
        if value < low:
            text += " (below the axis)"
        handles.append(Line2D([], [], color="black", linestyle=dash, linewidth=width, label=text))
    return handles


def _pairs_title(bars: ImprovementBars, prefix: str) -> str:
    title = plural(len(bars.series[0].values), "pair")
    if prefix:
        title += f" of {short(prefix.rstrip('_-/:.'), 30)}"
    title += ", best to worst"
    if bars.undefined:
        title += f"; {bars.undefined} without a defined improvement"
    return title
