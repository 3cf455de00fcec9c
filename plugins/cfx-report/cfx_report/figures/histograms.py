"""Histograms of calibrated parameters, in their units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plugin import JobFigure, Result, canvas, colours, parameter_spread, wording

_ACROSS = 5
_BINS = (6, 30)
"""Fewest and most bins; in between there are twice the square root of the number of pairs."""


@canvas.styled
def draw_histograms(spreads: Sequence[parameter_spread.ParameterSpread]) -> Figure:
    """Draws a panel per parameter: how many pairs have which driver-specific value.

    Bins lie between the bounds. Lines mark the default and the pooled values.

    Args:
        spreads: of at least one parameter.
    """
    across = min(canvas.most_across(_ACROSS), len(spreads))
    rows = -(-len(spreads) // across)
    figure = canvas.blank(0.8 + 2.2 * rows)
    grid = figure.subplots(rows, across, squeeze=False, sharey=True)
    for axes, spread in zip(grid.flat, spreads, strict=False):
        _histogram(axes, spread)
    for unused in grid.flat[len(spreads) :]:
        unused.set_visible(False)
    for row in grid:
        row[0].set_ylabel("pairs")
    canvas.legend_above(figure, grid[0, 0].get_legend_handles_labels()[0], handlelength=1.6)
    return figure


def _histogram(axes: Axes, spread: parameter_spread.ParameterSpread) -> None:
    assert spread.axis.low is not None
    assert spread.axis.high is not None
    bins = int(np.clip(2 * np.sqrt(len(spread.values)), *_BINS))
    edges = np.linspace(spread.axis.low, spread.axis.high, bins + 1)
    counts = np.histogram(np.clip(spread.values, edges[0], edges[-1]), edges)[0]
    axes.bar(
        edges[:-1],
        counts,
        width=np.diff(edges),
        align="edge",
        color=colours.colour_of("driver_specific"),
        edgecolor="white",
        linewidth=canvas.points(0.5),
        label=wording.method_label("driver_specific"),
    )
    marks = {"default": np.array([spread.default]), "pooled": spread.pooled}
    for method, values in marks.items():
        for number, value in enumerate(values):
            axes.axvline(
                value,
                color=colours.colour_of(method),
                linestyle=canvas.DASHES[method],
                linewidth=canvas.points(1.8),
                label=wording.method_label(method) if number == 0 else None,
            )
    axes.set_xlabel(wording.unit_label(spread.axis.name, spread.axis.unit))
    axes.set_xlim(edges[0], edges[-1])
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True, min_n_ticks=1))
    axes.grid(visible=False, axis="x")


class ParameterHistograms(JobFigure):
    """How many pairs have which calibrated parameters, in their units."""

    title = "Histograms of calibrated parameters"
    caption = (
        "How many pairs have which driver-specific value of each parameter, between its bounds; the"
        " lines are the model's default and the pooled values."
    )
    order = 71

    def draw(self, result: Result) -> Figure | None:
        """Draws it where drivers have parameters of their own."""
        spreads = parameter_spread.parameter_spreads(result.pairs, result.parameters)
        return draw_histograms(spreads) if spreads else None
