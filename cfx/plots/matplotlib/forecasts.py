"""Errors of forecasts."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cfx.plots.choice.forecasts import ForecastPanel
from cfx.plots.matplotlib.canvas import (
    canvas,
    draw_lines,
    logarithmic,
    mark_points,
    method_legend,
    styled,
)


@styled
def draw_forecasts(panels: Sequence[ForecastPanel], methods: Sequence[str], against: str) -> Figure:
    """Draws mean errors over drivers, a panel for each error.

    Args:
        panels: the panels, side by side.
        methods: of the legend.
        against: title of the horizontal axes.
    """
    figure = canvas(4.4)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(grid, panels, strict=True):
        draw_panel(axes, panel, against)
        if panel.logarithmic:
            logarithmic(axes)
        else:
            axes.set_ylim(bottom=0)
    method_legend(figure, methods)
    return figure


def draw_panel(axes: Axes, panel: ForecastPanel, against: str) -> None:
    """Draws the lines of one panel.

    Args:
        axes: to draw on.
        panel: its lines and the title of its vertical axis.
        against: title of the horizontal axis.
    """
    draw_lines(axes, panel.lines)
    mark_points(axes)
    axes.set_xlabel(against)
    axes.set_ylabel(panel.title)
