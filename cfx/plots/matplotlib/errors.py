"""Errors over time."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from cfx.plots.choice.errors import TIME_TITLE, ErrorPanel
from cfx.plots.look import EDGE, INK
from cfx.plots.matplotlib.canvas import canvas, draw_lines, method_legend, styled


@styled
def draw_errors(panels: Sequence[ErrorPanel], methods: Sequence[str]) -> Figure:
    """Draws RMSE of speed and of gap over all pairs at each moment since the test part began.

    All methods begin in the measured state. Constant parameters leave it for their own gap at once,
    so that a good part of what a policy gains may be gained in the first seconds: here it is seen.
    """
    figure = canvas(3.9)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(grid, panels, strict=True):
        draw_lines(axes, panel.lines)
        axes.set_xlabel(TIME_TITLE)
        axes.set_ylabel(panel.title)
        axes.set_ylim(bottom=0)
        axes.axhline(0, color=INK, linewidth=0.9)
        if panel.shows_transient:
            axes.axvline(panel.transient_s, color=EDGE, linewidth=0.9, linestyle=(0, (4, 2)))
    method_legend(figure, methods)
    return figure
