"""Pairs over time: speeds, gaps, and the parameters that the policy chose."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plots.choice.trajectories import (
    HIDDEN,
    TIME_TITLE,
    Note,
    PairPanels,
    Panel,
    bounds_text,
)
from cfx.plots.look import BAND, EDGE, INK, colour_of
from cfx.plots.matplotlib.canvas import canvas, draw_lines, method_legend, styled
from cfx.plots.words import short

_LINE = 150
"""Characters of a small title that fit into the width of a figure."""


@styled
def draw_pairs(
    titles: Sequence[tuple[str, str, str]],
    pairs: Sequence[PairPanels],
    methods: Sequence[str],
    explained: str | None = None,
) -> Figure:
    """Draws speed and gap of some pairs over the test part, a row per pair.

    Args:
        titles: of each pair: its own, that of its speeds, that of its gaps.
        pairs: what is shown.
        methods: for the legend.
        explained: what percentages in the titles mean; stands above the legend.
    """
    figure = canvas(0.75 + 2.35 * len(pairs))
    grid = figure.subplots(len(pairs), 2, squeeze=False, sharex="row", width_ratios=(1.12, 1.0))
    for (speed_axes, gap_axes), pair, title in zip(grid, pairs, titles, strict=True):
        draw_panel(speed_axes, pair.speed)
        draw_panel(gap_axes, pair.gap)
        _two_line_title(speed_axes, title[0], title[1])
        _two_line_title(gap_axes, "", title[2])
    for axes in grid[-1]:
        axes.set_xlabel(TIME_TITLE)
    method_legend(figure, ["real", "leader", *_visible(methods)], explained)
    return figure


@styled
def draw_speeds(pair_id: str, panels: Sequence[Panel], methods: Sequence[str]) -> Figure:
    """Draws the simulated speed of each method against the real driver's, a panel per method.

    Args:
        pair_id: which pair.
        panels: of each method.
        methods: for the legend.
    """
    figure = canvas(0.8 + 1.9 * len(panels))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, panel in zip(grid, panels, strict=True):
        draw_lines(axes, panel.lines)
        axes.set_title(panel.title, fontsize=9.5, color=INK)
        axes.set_ylabel("speed (m/s)")
    grid[-1].set_xlabel(TIME_TITLE)
    title = f"pair {short(pair_id, 60)}, test part"
    method_legend(figure, ["real", *methods], title)
    return figure


@styled
def draw_parameters(pair: PairPanels, methods: Sequence[str]) -> Figure:
    """Draws the parameters that each method used over time, a small panel per parameter.

    The first panel shows the speeds, so that a reader sees what the policy answers to. What lies
    outside a parameter's bounds is shaded, and its bounds and its meaning stand in the title.
    """
    count = len(pair.parameters)
    columns = _columns(count)
    rows = -(-(count + 1) // columns)
    figure = canvas(1.0 + (1.75 if columns == 1 else 2.0) * rows)
    grid = figure.add_gridspec(rows, columns)
    # The speeds take the cells that the parameters leave over, so that the grid has no hole.
    span = rows * columns - count
    speeds = figure.add_subplot(grid[0, :span])
    shown = [line for line in pair.speed.lines if line.method in {"leader", "real", "policy"}]
    draw_lines(speeds, shown)
    speeds.set_title(pair.speed.title)
    panels = [speeds]
    for k, panel in enumerate(pair.parameters):
        axes = figure.add_subplot(grid[divmod(k + span, columns)], sharex=speeds)
        draw_panel(axes, panel)
        _titles_of_parameter(axes, panel, _LINE // columns)
        axes.set_ylabel("")
        panels.append(axes)
    # Shared by all; labels of small axes must not touch.
    speeds.xaxis.set_major_locator(MaxNLocator(12 // columns, integer=True))
    for axes in panels:
        axes.tick_params(labelbottom=axes in panels[-columns:])
    figure.supxlabel(TIME_TITLE, fontsize=10.5, color=INK)
    title = f"pair {short(pair.pair_id, 60)}"
    method_legend(figure, ["real", "leader", *_visible(methods)], title)
    return figure


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draws lines, notes, collisions and bounds of one panel."""
    draw_lines(axes, panel.lines)
    if panel.low is not None and panel.high is not None:
        axes.set_ylim(panel.low, panel.high)
        if panel.bounds is not None:
            _shade_outside(axes, panel.bounds, panel.low, panel.high)
    axes.set_ylabel(panel.title)
    for note in panel.notes:
        _write_note(axes, note)
    for collision in panel.collisions:
        colour = colour_of(collision.method)
        place = (collision.time, collision.gap)
        axes.plot(*place, marker="X", markersize=9, color=colour, mec="white", zorder=6)
        axes.annotate(
            collision.text,
            place,
            (6, 6),
            textcoords="offset points",
            color=colour,
            fontsize=9,
            annotation_clip=True,
        )
        axes.axhline(0, color=INK, linewidth=0.8)


def _visible(methods: Sequence[str]) -> list[str]:
    return [method for method in methods if method not in HIDDEN]


def _columns(parameters: int) -> int:
    for columns, most in ((1, 2), (2, 5), (3, 8)):
        if parameters <= most:
            return columns
    return 4


def _shade_outside(axes: Axes, bounds: tuple[float, float], low: float, high: float) -> None:
    width = high - low
    axes.axhspan(min(low, bounds[0]) - width, bounds[0], color=BAND, zorder=0)
    axes.axhspan(bounds[1], max(high, bounds[1]) + width, color=BAND, zorder=0)
    for bound in bounds:
        axes.axhline(bound, color=EDGE, linewidth=0.9, zorder=1)
    axes.set_ylim(low, high)


def _titles_of_parameter(axes: Axes, panel: Panel, length: int) -> None:
    """Writes name, unit and bounds, and below them what the parameter means."""
    lines = textwrap.wrap(panel.meaning, length, max_lines=2, placeholder=" …")
    axes.set_title("\n".join(lines), fontsize=8, color=INK)
    raised = 6 + 11 * len(lines)
    axes.annotate(
        bounds_text(panel),
        (0, 1),
        (0, raised),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=10.5,
        color="black",
    )


def _two_line_title(axes: Axes, strong: str, fine: str) -> None:
    axes.set_title(fine, fontsize=7.6, color=INK)  # several methods' errors beside each other
    if strong:
        axes.annotate(
            strong,
            (0, 1),
            (0, 20),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=11,
            fontweight="bold",
            color="black",
        )


def _write_note(axes: Axes, note: Note) -> None:
    height, aligned = (0.97, "top") if note.above else (0.03, "bottom")
    axes.text(
        0.985,
        height,
        note.text,
        transform=axes.transAxes,
        ha="right",
        va=aligned,
        color=colour_of(note.method),
        fontsize=9,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5},
        zorder=5,
    )
