"""Traffic of sampled drivers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.metrics.base import RECORDED
from cfx.plots.choice.traffic import PathPanel, TrafficPanel
from cfx.plots.look import BAND, EDGE
from cfx.plots.matplotlib.canvas import canvas, draw_lines, mark_points, method_legend, styled
from cfx.plots.words import label

_COLUMNS = 2


@styled
def draw_traffic(panels: Sequence[TrafficPanel], methods: Sequence[str]) -> Figure:
    """Draws the panels, two beside each other.

    Args:
        panels: flow, variation, waves and growth.
        methods: of the legend, besides the recorded drivers.
    """
    rows = -(-len(panels) // _COLUMNS)
    figure = canvas(3.6 * rows + 0.6)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes, panel in zip(grid, panels, strict=False):
        axes.scatter(*panel.cloud, s=5, color=EDGE, alpha=0.25, linewidths=0, zorder=1)
        if panel.band is not None:
            axes.axhspan(*panel.band, color=BAND, zorder=0.5)
        draw_lines(axes, panel.lines)
        if len(panel.lines) and len(panel.lines[0].time) < 15:
            mark_points(axes)
        axes.set_xlabel(panel.against)
        axes.set_ylabel(panel.title)
        if panel.limits is not None:
            axes.set_ylim(*panel.limits)
        else:
            axes.set_ylim(bottom=0)
    for axes in grid[len(panels) :]:
        axes.remove()
    method_legend(figure, [RECORDED, *methods])
    return figure


@styled
def draw_paths(panels: Sequence[PathPanel]) -> Figure:
    """Draws the vehicles of one ring over time, coloured by their speed; a panel per method."""
    columns = min(3, max(1, len(panels)))
    rows = -(-len(panels) // columns)
    figure = canvas(2.9 * rows + 0.4)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    fastest = max((float(panel.speed.max(initial=0.0)) for panel in panels), default=1.0)
    drawn = None
    for axes, panel in zip(grid, panels, strict=False):
        drawn = axes.scatter(
            panel.time,
            panel.place,
            c=panel.speed,
            s=2.0,
            linewidths=0,
            cmap="viridis",
            vmin=0.0,
            vmax=max(fastest, 1.0),
            rasterized=True,
        )
        axes.set_title(label(panel.method))
        axes.grid(visible=False)
        if len(panel.time):
            axes.set_xlim(0.0, float(np.max(panel.time)))
    for axes in grid[len(panels) :]:
        axes.remove()
    figure.supxlabel("time (s)", fontsize=10.5)
    figure.supylabel("place on the ring (m)", fontsize=10.5)
    if drawn is not None:
        figure.colorbar(drawn, ax=grid[: len(panels)].tolist(), label="speed (m/s)", pad=0.01)
    return figure
