"""String stability: what becomes of a leader's braking along a platoon of ten followers."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cfx.evaluation.result import Platoon
from cfx.figures.look import COLOURS, LABELS, canvas, number, styled

_SHOWN_BEFORE = 10.0
"""Seconds before the leader brakes from which on the platoon is drawn; before that it settles."""


@styled
def platoons(platoon: Platoon) -> Figure:
    """Speeds of the leader and its followers over time, a panel per method.

    Of a method with several networks the one is drawn whose last follower becomes slowest; the title counts the stable ones.
    """
    methods = platoon.methods
    figure = canvas(4.3, width=10.5 if len(methods) > 1 else 6.5)
    panels = figure.subplots(1, len(methods), sharey=True, sharex=True, squeeze=False)[0]
    for axes, method in zip(panels, methods, strict=True):
        measures = platoon.measures[platoon.measures["method"] == method]
        rows, network = worst_platoon(platoon.table[platoon.table["method"] == method])
        _speeds(axes, rows)
        axes.set_title(_title(method, measures, network), fontsize=9.5)
        axes.set_xlabel("time from the braking of the leader (s)")
    panels[0].set_ylabel("speed (m/s)")
    figure.legend(handles=_handles(), loc="outside upper center", ncols=4, columnspacing=1.8)
    return figure


def worst_platoon(table: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """Returns the rows of the network whose last follower becomes slowest once the leader brakes, and the network's name.

    Args:
        table: one method's rows of a platoon's table.
    """
    last = table[
        (table["vehicle"] == table["vehicle"].max()) & (table["time_s"] >= braking_time(table))
    ]
    network = last.loc[last["speed"].idxmin(), "network"]
    return table[table["network"] == network], str(network)


def braking_time(table: pd.DataFrame) -> float:
    """Returns when the leader of a platoon's table begins to brake, s."""
    leader = table[table["vehicle"] == 0].drop_duplicates("time_s").sort_values("time_s")
    speed = leader["speed"].to_numpy()
    return float(leader["time_s"].iloc[max(int(np.argmax(speed < speed[0])) - 1, 0)])


def vehicle_colour(vehicle: int, vehicles: int) -> str:
    """Returns the colour of the follower `vehicle` (1 and up) among `vehicles`: the first dark, the last light."""
    return to_hex(colormaps["viridis"](0.92 * (vehicle - 1) / max(vehicles - 1, 1)))


def _speeds(axes: Axes, rows: pd.DataFrame) -> None:
    begin = braking_time(rows)
    shown = rows[rows["time_s"] >= begin - _SHOWN_BEFORE]
    last = int(shown["vehicle"].max())
    for vehicle, drive in shown.groupby("vehicle"):
        k = int(str(vehicle))
        colour = COLOURS["real"] if k == 0 else vehicle_colour(k, last)
        axes.plot(
            drive["time_s"] - begin,
            drive["speed"],
            color=colour,
            linewidth=2.0 if k == 0 else 1.3,
            zorder=3 if k == 0 else 2,
        )
    crashed = shown[shown["gap"] < 0]
    for _, drive in crashed.groupby("vehicle"):
        hit = drive.iloc[0]
        axes.plot(
            hit["time_s"] - begin,
            hit["speed"],
            marker="X",
            color="#d00000",
            markeredgecolor="white",
            markersize=9,
            zorder=4,
        )
    axes.margins(x=0.01)


def _title(method: str, measures: pd.DataFrame, network: str) -> str:
    many, stable = len(measures) > 1, int(measures["string_stable"].sum())
    said = (
        f"{stable} of {len(measures)} platoons are string stable"
        if many
        else f"{'' if stable else 'not '}string stable"
    )
    factor = float(measures.set_index("network")["head_to_tail"][network])
    times = f"{number(factor)} times the leader's drop" if np.isfinite(factor) else "undefined"
    return f"{LABELS[method]}\n{said}\nlast follower: {times}"


def _handles() -> list[Line2D]:
    return [
        Line2D([], [], color=COLOURS["real"], linewidth=2.0, label="leader"),
        Line2D([], [], color=vehicle_colour(1, 10), linewidth=1.6, label="first follower"),
        Line2D([], [], color=vehicle_colour(10, 10), linewidth=1.6, label="last follower"),
        Line2D(
            [],
            [],
            color="#d00000",
            marker="X",
            linestyle="none",
            markeredgecolor="white",
            markersize=9,
            label="collision",
        ),
    ]
