"""The figure of a scenario: flows, headways, and the paths of vehicles on its busiest lane."""

from __future__ import annotations

from typing import Any

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
    fastest = 0.0
    for name, observations in runs.items():
        speed_of_lanes, flow_of_lanes, headways_of_lanes = [], [], [np.zeros(0)]
        for lane_flow in lane_flows(observations).values():
            speed_of_lanes.append(lane_flow.speed)
            flow_of_lanes.append(lane_flow.flow)
            headways_of_lanes.append(lane_flow.headways)
        style: dict[str, Any] = {"markersize": 4, "alpha": 0.7, "color": shades[name]}
        flows.plot(speed_of_lanes, flow_of_lanes, "o", label=name, **style)
        times = np.concatenate(headways_of_lanes)
        times = times[times < _LONGEST_S]
        bins = np.arange(0.0, _LONGEST_S + 0.01, 0.25)
        if len(times):
            headways.hist(
                times, bins, density=True, histtype="step", linewidth=1.8, color=shades[name]
            )
        fastest = max(fastest, observations.speed.max(initial=0.0))
    flows.margins(0.1)
    flows.set(xlabel="mean speed of a lane [m/s]", ylabel="flow [vehicles/h]", title="lanes")
    flows.set(xlim=(0, None), ylim=(0, None))
    flows.legend(loc="upper left")
    headways.set(xlabel="time headway [s]", ylabel="density [1/s]", title="headways")
    lane = busiest_lane(report.driven)
    coloured = None
    for axes, (name, observations) in zip(paths, runs.items(), strict=True):
        coloured = _draw_paths(axes, observations, lane, fastest) or coloured
        axes.set_title(f"{name}: lane {lane}")
    # Both over the same time, to be compared.
    first, last = np.array([axes.get_xlim() for axes in paths]).T
    for axes in paths:
        axes.set_xlim(first.min(), last.max())
    if coloured is not None:
        figure.colorbar(coloured, ax=list(paths), label="speed [m/s]", pad=0.02)
    return figure


def _draw_paths(
    axes: Axes, observations: Observations, lane: str | None, fastest: float
) -> LineCollection | None:
    """Draws the vehicles of a lane over time, by their speed; None where there are none."""
    axes.set(xlabel="time [s]", ylabel="position [m]")
    if lane not in observations.lanes:
        return None
    number = observations.lanes.index(lane)
    vehicle, is_on_lane = observations.vehicle, observations.lane == number
    # Whether a line leads from each observation to the next one, `(N - 1,)`.
    is_joined = (vehicle[1:] == vehicle[:-1]) & is_on_lane[1:] & is_on_lane[:-1]
    is_joined &= np.diff(observations.time) < 1.5 * EVERY_S
    # On a ring a vehicle comes back to the beginning of its lane.
    is_joined &= np.diff(observations.position) > -1.0
    points = np.stack([observations.time, observations.position], 1)  # (N, 2)
    lines = np.stack([points[:-1][is_joined], points[1:][is_joined]], 1)  # (lines, 2 ends, 2)
    coloured = LineCollection(list(lines), cmap="viridis", linewidths=0.8)
    coloured.set_array(observations.speed[1:][is_joined])
    coloured.set_clim(0.0, fastest or 1.0)
    axes.add_collection(coloured)
    axes.autoscale()
    return coloured
