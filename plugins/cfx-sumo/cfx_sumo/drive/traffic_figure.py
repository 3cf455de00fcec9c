"""The figure of a driver's traffic: speed and flow, rings, a dip along a platoon."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cfx.plugin import canvas, colours, steady, traffic

if TYPE_CHECKING:
    from cfx_sumo.drive.traffic import TrafficReport

_HEIGHT = 4.0


@canvas.styled
def draw_traffic(report: TrafficReport) -> Figure:
    """Draws recorded and driven flows by speed, flows of rings by density, and dips.

    Args:
        report: what was measured.
    """
    figure = canvas.blank(_HEIGHT)
    flows, rings, platoon = canvas.side_by_side(figure, (1.25, 1.0, 1.0))
    _draw_flows(flows, report)
    _draw_rings(rings, report)
    _draw_dips(platoon, report)
    return figure


def _draw_flows(axes: Axes, report: TrafficReport) -> None:
    relation = report.recorded.relation
    slow, fast = (
        steady.flow(relation.speed, relation.high),
        steady.flow(relation.speed, relation.low),
    )
    real = colours.colour_of("real")
    axes.fill_between(
        relation.speed,
        slow,
        fast,
        color=real,
        alpha=0.12,
        linewidth=0,
        label="half of the recorded drivers",
    )
    of_lane = steady.flow(relation.speed, relation.gap)
    label = f"recorded ({report.recorded.of})"
    axes.plot(relation.speed, of_lane, color=real, marker="o", markersize=3, label=label)
    policy = colours.colour_of("policy")
    for start, style, number in zip(traffic.TIME_GAPS_S, ("-", "--"), (0, 1), strict=True):
        axes.plot(
            traffic.SPEEDS_MPS,
            report.alone.equilibrium[:, number],
            style,
            color=policy,
            label=f"driven, from {start:g} s",
        )
    axes.set(xlabel="speed [m/s]", ylabel="flow [vehicles/h]", title="behind a constant speed")
    axes.set_ylim(0, 1.05 * max(3000.0, float(report.alone.equilibrium.max())))
    axes.set_xlim(0, None)
    axes.legend(loc="lower right")


def _draw_rings(axes: Axes, report: TrafficReport) -> None:
    usual = traffic.USUAL["capacity"]
    axes.axhspan(
        usual.low, usual.high, color=colours.EDGE, alpha=0.25, linewidth=0, label="usual capacity"
    )
    density, flow = report.alone.ring.T
    axes.plot(density, flow, color=colours.colour_of("policy"), marker="o", markersize=3)
    axes.set(xlabel="density [vehicles/km]", title="rings", ylim=(0, None))
    axes.set_xlim(0, None)
    axes.legend(loc="lower right")


def _draw_dips(axes: Axes, report: TrafficReport) -> None:
    dips = report.alone.dips
    axes.axhline(traffic.DIP_MPS, color=colours.EDGE, linewidth=1.0, label="the leader's")
    axes.plot(np.arange(len(dips)), dips, color=colours.colour_of("policy"))
    axes.set(xlabel="vehicle of a platoon", ylabel="slows down by [m/s]", ylim=(0, None))
    axes.set_title("behind a dip of 5 m/s")
    axes.legend(loc="lower right")
