"""Draws `drive.png`: time-space diagrams of the scenarios `ring` and `motorway` with `cfx://idm`.

In a checkout:

    python -m cfx drive ring --output ring.csv
    python -m cfx drive motorway --output motorway.csv
    python docs/drive.py ring.csv motorway.csv
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from cfx.plugin import canvas, drawing

PICTURE = Path(__file__).with_name("drive.png")
COLUMNS = ["time_s", "vehicle", "edge", "lane", "position_m", "speed_mps"]
RING_M = {"north": 0.0, "south": 119.38}  # m: where the halves of the ring begin
BUSIEST = ("1003", 0)  # edge and lane of the motorway behind its ramp
EVERY = 10  # frames of 0.1 s


def on_ring(paths: pd.DataFrame) -> pd.DataFrame:
    """Returns positions along the whole ring; the few metres of its joints are left out."""
    begins = paths["edge"].map(RING_M)
    return paths.assign(position_m=paths["position_m"] + begins)[begins.notna()]


def on_lane(paths: pd.DataFrame) -> pd.DataFrame:
    """Returns the vehicles of one lane of the motorway."""
    edge, lane = BUSIEST
    return paths[(paths["edge"].astype(str) == edge) & (paths["lane"] == lane)]


@canvas.styled
def draw(ring: pd.DataFrame, motorway: pd.DataFrame) -> Figure:
    """Draws both scenarios side by side."""
    figure = canvas.blank(3.9)
    left, right = canvas.side_by_side(figure, (1.0, 1.0))
    draw_paths(figure, left, ring, "ring: 22 vehicles on 239 m")
    draw_paths(figure, right, motorway, "motorway: a lane behind the ramp")
    return figure


def draw_paths(figure: Figure, axes: Axes, paths: pd.DataFrame, title: str) -> None:
    """Draws a line a second of each vehicle, coloured by speed."""
    lines, speeds = [], []
    for _, rows in paths.groupby("vehicle"):
        path = rows.sort_values("time_s").iloc[::EVERY]
        points = path[["time_s", "position_m"]].to_numpy()
        # A vehicle that has left the lane, or passed the ring's beginning, begins a new line.
        follows = (path["time_s"].diff() < 1.5) & (path["position_m"].diff() >= 0.0)
        for number in follows.to_numpy().nonzero()[0]:
            lines.append(points[number - 1 : number + 1])
            speeds.append(path["speed_mps"].iloc[number])
    drawn = LineCollection(lines, cmap="viridis", linewidths=0.8)
    drawn.set_array(speeds)
    drawn.set_clim(vmin=0.0)
    axes.add_collection(drawn)
    axes.autoscale()
    axes.set(title=title, xlabel="time [s]", ylabel="position [m]")
    figure.colorbar(drawn, ax=axes, label="speed [m/s]")


def read(path: str, keep: Callable[[pd.DataFrame], pd.DataFrame]) -> pd.DataFrame:
    """Reads what `cfx drive --output` wrote."""
    return keep(pd.read_csv(path, usecols=COLUMNS))


if __name__ == "__main__":
    _, ring_file, motorway_file = sys.argv
    drawing.write_figure(draw(read(ring_file, on_ring), read(motorway_file, on_lane)), PICTURE)
