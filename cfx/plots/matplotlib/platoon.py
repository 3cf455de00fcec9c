"""Platoons behind a braking leader."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cfx.plots.choice.platoon import TIME_TITLE, PlatoonPanel, speed_range
from cfx.plots.look import COLLISION_COLOUR, COLOURS, vehicle_colour
from cfx.plots.matplotlib.canvas import canvas, styled


@styled
def draw_platoons(panels: Sequence[PlatoonPanel]) -> Figure:
    """Draws speeds of the leader and its followers over time, a panel per method."""
    figure = canvas(4.3, width=10.5 if len(panels) > 1 else 6.5)
    grid = figure.subplots(1, len(panels), sharey=True, sharex=True, squeeze=False)[0]
    for axes, panel in zip(grid, panels, strict=True):
        _speeds(axes, panel)
        axes.set_title("\n".join([panel.title, *panel.verdicts]), fontsize=_title_size(panels))
        axes.margins(x=0.01)
    figure.supxlabel(TIME_TITLE, fontsize=10.5)
    grid[0].set_ylabel("speed (m/s)")
    grid[0].set_ylim(*speed_range(panels))
    figure.legend(handles=_handles(), loc="outside upper center", ncols=4, columnspacing=1.8)
    return figure


def _title_size(panels: Sequence[PlatoonPanel]) -> float:
    return 9.5 if len(panels) < 4 else 7.5


def _speeds(axes: Axes, panel: PlatoonPanel) -> None:
    for line in panel.lines:
        leads = line.vehicle == 0
        width, above = (2.0, 3) if leads else (1.3, 2)
        axes.plot(line.time, line.speed, color=line.colour, linewidth=width, zorder=above)
        if line.collision is not None:
            axes.plot(
                *line.collision,
                marker="X",
                color=COLLISION_COLOUR,
                markeredgecolor="white",
                markersize=9,
                zorder=4,
            )


def _handles() -> list[Line2D]:
    return [
        Line2D([], [], color=COLOURS["real"], linewidth=2.0, label="leader"),
        Line2D([], [], color=vehicle_colour(1, 10), linewidth=1.6, label="first follower"),
        Line2D([], [], color=vehicle_colour(10, 10), linewidth=1.6, label="last follower"),
        Line2D(
            [],
            [],
            color=COLLISION_COLOUR,
            marker="X",
            linestyle="none",
            markeredgecolor="white",
            markersize=9,
            label="collision",
        ),
    ]
