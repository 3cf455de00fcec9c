"""The figure of a scenario: flows, headways, and the paths of vehicles on its busiest lane."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from cfx.plugin import canvas, colours
from cfx_sumo.drive.scenario_report import (
    EVERY_S,
    Observations,
    ScenarioReport,
    busiest_lane,
    lane_flows,
)

_HEIGHT = 7.0
_LONGEST_S = 6.0
"""Headways above are of vehicles that do not follow one another."""


@canvas.styled
def draw_report(report: ScenarioReport) -> Figure:
    """Draws the scenario with drivers of cfx beside the same with SUMO's own models."""
    figure = canvas.blank(_HEIGHT)
    (flows, headways), paths = figure.subplots(2, 2)
    runs = {"cfx": report.driven, "SUMO's own models": report.plain}
    shades = {"cfx": colours.colour_of("policy"), "SUMO's own models": colours.colour_of("default")}
    for name, seen in runs.items():
        of_lanes = lane_flows(seen).values()
        speed = [one.speed for one in of_lanes]
        flow = [one.flow for one in of_lanes]
        flows.plot(speed, flow, "o", markersize=4, alpha=0.7, color=shades[name], label=name)
        gaps = np.concatenate([np.zeros(0), *(one.headways for one in of_lanes)])
        gaps = gaps[gaps < _LONGEST_S]
        bins = np.arange(0.0, _LONGEST_S + 0.01, 0.25)
        if len(gaps):
            headways.hist(
                gaps, bins, density=True, histtype="step", linewidth=1.8, color=shades[name]
            )
    flows.margins(0.1)
    flows.set(xlabel="mean speed of a lane [m/s]", ylabel="flow [vehicles/h]", title="lanes")
    flows.set(xlim=(0, None), ylim=(0, None))
    flows.legend(loc="upper left")
    headways.set(xlabel="time headway [s]", ylabel="density [1/s]", title="headways")
    lane = busiest_lane(report.driven)
    fastest = max((float(seen.speed.max()) for seen in runs.values() if len(seen.speed)), default=1)
    drawn = None
    for axes, (name, seen) in zip(paths, runs.items(), strict=True):
        drawn = _draw_paths(axes, seen, lane, fastest) or drawn
        axes.set_title(f"{name}: lane {lane}")
    # Both over the same time, to be compared.
    ends = [axes.get_xlim() for axes in paths]
    for axes in paths:
        axes.set_xlim(min(low for low, _ in ends), max(high for _, high in ends))
    if drawn is not None:
        figure.colorbar(drawn, ax=list(paths), label="speed [m/s]", pad=0.02)
    return figure


def _draw_paths(
    axes: Axes, seen: Observations, lane: str | None, fastest: float
) -> LineCollection | None:
    """Draws the vehicles of a lane over time, by their speed; None where there are none."""
    axes.set(xlabel="time [s]", ylabel="position [m]")
    if lane not in seen.lanes:
        return None
    number = seen.lanes.index(lane)
    together = (seen.vehicle[1:] == seen.vehicle[:-1]) & (seen.lane[1:] == number)
    together &= (seen.lane[:-1] == number) & (np.diff(seen.time) < 1.5 * EVERY_S)
    # On a ring a vehicle comes back to the beginning of its lane.
    together &= np.diff(seen.position) > -1.0
    points = np.stack([seen.time, seen.position], 1)
    lines = np.stack([points[:-1][together], points[1:][together]], 1)
    drawn = LineCollection(list(lines), cmap="viridis", linewidths=0.8)
    drawn.set_array(seen.speed[1:][together])
    drawn.set_clim(0.0, fastest)
    axes.add_collection(drawn)
    axes.autoscale()
    return drawn
