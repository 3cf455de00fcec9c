"""Traffic of sampled drivers: flow, variation and waves against density, growth along platoons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.plugin import RECORDED, JobFigure, Result, canvas, colours, wording
from cfx_forecasts.traffic.summary import binned, mean_growth, ring_means, traffic_methods

DENSITY_TITLE = "density (vehicles/km)"
FLOW_TITLE = "flow (vehicles/h)"
VEHICLE_TITLE = "vehicle of the platoon"

PEOPLE_KMH = (-20.0, -15.0)
"""km/h: how fast stop-and-go waves of people travel (Treiber and Kesting, 2013, chapter 18)."""

WAVE_LIMITS = (-40.0, 10.0)
"""km/h: between these waves are shown; on nearly empty rings nothing worth the name travels."""

_MOST_POINTS = 1500

_NOISE = "_ar"
"""What methods end with that are constant parameters with noise."""


@dataclass(frozen=True)
class TrafficPanel:
    """One panel.

    Attributes:
        title: of the vertical axis.
        against: title of the horizontal one.
        lines: by method, and `real` where the recording says something; what `Line` calls time is
            what the values stand against.
        cloud: recorded points below the lines, x and y; empty if there are none.
        band: values that people show elsewhere; None if there are none.
        limits: of the vertical axis; None: from 0 to the largest value. Some lines may leave it.
    """

    title: str
    against: str
    lines: tuple[canvas.Line, ...]
    cloud: tuple[canvas.Array, canvas.Array] = (np.empty(0), np.empty(0))
    band: tuple[float, float] | None = None
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class PathPanel:
    """The vehicles of one ring over time.

    Attributes:
        method: who drives them.
        time, place, speed: of all points, s, m and m/s.
    """

    method: str
    time: canvas.Array
    place: canvas.Array
    speed: canvas.Array


def traffic_panels(
    roads: pd.DataFrame,
    growth: pd.DataFrame,
    strips: pd.DataFrame,
    real_wave_speed: float,
    methods: Sequence[str],
) -> tuple[TrafficPanel, ...]:
    """Chooses flow, variation, waves and growth, in this order; without platoons no growth.

    Args:
        roads, growth, strips: the tables `Roads`, `Growth` and `Strips`.
        real_wave_speed: of the recording, km/h; NaN if it is not known.
        methods: those to show.
    """
    recorded = strips[strips["method"] == RECORDED]
    every = max(1, -(-len(recorded) // _MOST_POINTS))
    shown = recorded.iloc[::every]
    cloud = (shown["density"].to_numpy(dtype=float), shown["flow"].to_numpy(dtype=float))
    bins = binned(strips)
    last = bins.loc[bins["method"] == RECORDED, "density"].max()
    if np.isfinite(last):
        bins = bins[bins["density"] <= last]
    panels = [
        TrafficPanel(FLOW_TITLE, DENSITY_TITLE, _flows(roads, bins, methods), cloud),
        TrafficPanel(
            "std of speed within 10 s (m/s)",
            DENSITY_TITLE,
            _of_bins(bins, (*methods, RECORDED), "speed_std"),
        ),
        TrafficPanel(
            "speed of waves (km/h)",
            DENSITY_TITLE,
            _waves(roads, real_wave_speed, methods),
            band=PEOPLE_KMH,
            limits=WAVE_LIMITS,
        ),
    ]
    if len(growth):
        lines = []
        for method in methods:
            means = mean_growth(growth[growth["method"] == method])
            place = means.index.to_numpy(dtype=float)
            lines.append(canvas.Line(method, place, means.to_numpy(dtype=float)))
        limits = _growth_limits(lines)
        panels.append(
            TrafficPanel("std of speed (m/s)", VEHICLE_TITLE, tuple(lines), limits=limits)
        )
    return tuple(panels)


def path_panels(paths: pd.DataFrame, methods: Sequence[str]) -> tuple[PathPanel, ...]:
    """Chooses the paths of one ring for each method.

    Args:
        paths: the table `Paths`.
        methods: those to show.
    """
    panels = []
    for method in methods:
        rows = paths[paths["method"] == method]
        columns = [rows[name].to_numpy(dtype=float) for name in ("time_s", "place", "speed")]
        panels.append(PathPanel(method, *columns))
    return tuple(panels)


def _flows(
    roads: pd.DataFrame, bins: pd.DataFrame, methods: Sequence[str]
) -> tuple[canvas.Line, ...]:
    lines = []
    for method in methods:
        means = ring_means(roads[roads["method"] == method], ["flow"])
        lines.append(_line(method, means["level"], means["flow"]))
    return (*lines, *_of_bins(bins, (RECORDED,), "flow"))


def _of_bins(bins: pd.DataFrame, methods: Sequence[str], column: str) -> tuple[canvas.Line, ...]:
    lines = []
    for method in methods:
        rows = bins[bins["method"] == method].sort_values("density")
        lines.append(_line(method, rows["density"], rows[column]))
    return tuple(lines)


def _waves(roads: pd.DataFrame, real: float, methods: Sequence[str]) -> tuple[canvas.Line, ...]:
    lines = []
    for method in methods:
        means = ring_means(roads[roads["method"] == method], ["wave_speed"])
        lines.append(_line(method, means["level"], means["wave_speed"]))
    if np.isfinite(real):
        rings = roads[roads["road"] == "ring"]
        ends = np.array([rings["level"].min(), rings["level"].max()], dtype=float)
        lines.append(canvas.Line(RECORDED, ends, np.array([real, real])))
    return tuple(lines)


def _growth_limits(lines: Sequence[canvas.Line]) -> tuple[float, float] | None:
    """Returns the axis that the policy's growth can be seen on, if it has any.

    Constant parameters with noise may vary ten times as much.
    """
    top = 0.0
    for line in lines:
        if not line.method.endswith(_NOISE):
            top = max(top, float(np.nanmax(line.values, initial=0.0)))
    return (0.0, 1.3 * top) if top > 0.2 else None


def _line(method: str, against: pd.Series, values: pd.Series) -> canvas.Line:
    return canvas.Line(method, against.to_numpy(dtype=float), values.to_numpy(dtype=float))


_COLUMNS = 2


@canvas.styled
def draw_traffic(panels: Sequence[TrafficPanel], methods: Sequence[str]) -> Figure:
    """Draws the panels, two beside each other.

    Args:
        panels: flow, variation, waves and growth.
        methods: of the legend, besides the recorded drivers.
    """
    rows = -(-len(panels) // _COLUMNS)
    figure = canvas.blank(3.6 * rows + 0.6)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes, panel in zip(grid, panels, strict=False):
        axes.scatter(*panel.cloud, s=5, color=colours.EDGE, alpha=0.25, linewidths=0, zorder=1)
        if panel.band is not None:
            axes.axhspan(*panel.band, color=colours.BAND, zorder=0.5)
        canvas.draw_lines(axes, panel.lines)
        if len(panel.lines) and len(panel.lines[0].time) < 15:
            canvas.mark_points(axes)
        axes.set_xlabel(panel.against)
        axes.set_ylabel(panel.title)
        if panel.limits is not None:
            axes.set_ylim(*panel.limits)
        else:
            axes.set_ylim(bottom=0)
    for axes in grid[len(panels) :]:
        axes.remove()
    canvas.method_legend(figure, [RECORDED, *methods])
    return figure


@canvas.styled
def draw_paths(panels: Sequence[PathPanel]) -> Figure:
    """Draws the vehicles of one ring over time, coloured by their speed; a panel per method."""
    columns = min(3, max(1, len(panels)))
    rows = -(-len(panels) // columns)
    figure = canvas.blank(2.9 * rows + 0.4)
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
        axes.set_title(wording.method_label(panel.method))
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


class TrafficFigure(JobFigure):
    """Flow, variation, waves and growth of traffic."""

    title = "Traffic of sampled drivers"
    caption = (
        "Lines over density: means of ring roads. Grey points and the black line are recorded."
        " Waves: how fast changes of speed travel from vehicle to vehicle; the band is what people"
        " show in congestion. The last panel has platoons behind leaders that keep their speed."
    )
    order = 120

    def draw(self, result: Result) -> Figure | None:
        """Draws it where traffic was simulated."""
        roads = result.tables.get("traffic")
        growth, strips = result.tables.get("traffic_growth"), result.tables.get("traffic_strips")
        if roads is None or growth is None or strips is None:
            return None
        real = result.metrics.get(f"traffic/wave_speed/{RECORDED}", math.nan)
        methods = traffic_methods(roads)
        return draw_traffic(traffic_panels(roads, growth, strips, real, methods), methods)


class TrafficPaths(JobFigure):
    """The vehicles of one ring over time."""

    title = "Vehicles of one ring road over time"
    caption = "A panel per method; a point is a vehicle at a moment, its colour is its speed."
    order = 121

    def draw(self, result: Result) -> Figure | None:
        """Draws it where paths were kept."""
        paths, roads = result.tables.get("traffic_paths"), result.tables.get("traffic")
        if paths is None or roads is None or not len(paths):
            return None
        return draw_paths(path_panels(paths, traffic_methods(roads)))
