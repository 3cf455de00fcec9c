"""String stability: what becomes of a leader's braking along a platoon of ten followers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cfx.plugin import JobFigure, Result, canvas, colours, key_of, wording

TIME_TITLE = "time from the braking of the leader (s)"

_SHOWN_BEFORE = 10.0
"""Seconds before the leader brakes from which on the platoon is shown; before that it settles."""

_MOST_POINTS = 400

_COLLISION: dict[str, Any] = {
    "marker": "X",
    "color": colours.COLLISION_COLOUR,
    "markeredgecolor": "white",
    "markersize": 9,
}


def worst_platoon(table: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """Returns the rows of the network whose last follower becomes slowest, and the network's name.

    Args:
        table: one method's rows of a platoon's table.
    """
    is_last = table["vehicle"] == table["vehicle"].max()
    last = table[is_last & (table["time_s"] >= braking_time(table))]
    network = last.loc[last["speed"].idxmin(), "network"]
    return table[table["network"] == network], str(network)


def braking_time(table: pd.DataFrame) -> float:
    """Returns when the leader of a platoon's table begins to brake, s."""
    leader = table[table["vehicle"] == 0].drop_duplicates("time_s").sort_values("time_s")
    speed = leader["speed"].to_numpy()
    first_slower = int(np.argmax(speed < speed[0]))
    return float(leader["time_s"].iloc[max(first_slower - 1, 0)])


def _stability(share: float, networks: int) -> str:
    stable = round(share * networks)
    if networks > 1:
        return f"{stable} of {networks} platoons are string stable"
    return "string stable" if stable else "not string stable"


def _slowing(rows: pd.DataFrame) -> str:
    """Says by how many times as much as the leader the last follower slows down."""
    if bool((rows["gap"] < 0).any()):
        return "not defined, as vehicles collide"
    after = rows[rows["time_s"] >= braking_time(rows)].sort_values("time_s")
    leader = _drop(after[after["vehicle"] == 0])
    last = _drop(after[after["vehicle"] == after["vehicle"].max()])
    if not (leader > 0 and np.isfinite(last)):
        return "not defined"
    return f"{wording.number_text(last / leader)} times the leader's drop"


def _drop(rows: pd.DataFrame) -> float:
    """Returns from the highest speed before it to the lowest speed, m/s."""
    speed = rows["speed"].to_numpy(dtype=float)
    when = int(speed.argmin())
    return float(speed[: when + 1].max() - speed[when])


@canvas.styled
def draw_platoons(
    table: pd.DataFrame, methods: Sequence[str], stable: Mapping[str, float]
) -> Figure:
    """Draw speeds of the leader and its followers over time, a panel per method.

    Args:
        table: as `Platoon.table`.
        methods: those to show, in their order.
        stable: by method the share of its platoons that are string stable; one that is not known
            is left out of the titles.
    """
    figure = canvas.blank(4.3, width=10.5 if len(methods) > 1 else 6.5)
    grid = canvas.side_by_side(figure, [1] * len(methods), sharey=True, sharex=True)
    speeds, collides = [np.empty(0)], False
    for axes, method in zip(grid, methods, strict=True):
        of_method = table[table["method"] == method]
        rows, _ = worst_platoon(of_method)
        title = [wording.method_label(method)]
        if method in stable:
            title.append(_stability(stable[method], int(of_method["network"].nunique())))
        title.append(f"last follower: {_slowing(rows)}")
        speeds += _draw_vehicles(axes, rows)
        collides = collides or bool((rows["gap"] < 0).any())
        axes.set_title("\n".join(title), fontsize=canvas.points(9.5 if len(methods) < 4 else 7.5))
        axes.margins(x=0.01)
    figure.supxlabel(TIME_TITLE, fontsize=canvas.points(10.5))
    grid[0].set_ylabel("speed (m/s)")
    grid[0].set_ylim(*_speed_range(canvas.finite(np.concatenate(speeds))))
    canvas.legend_above(figure, _handles(collides), 4, columnspacing=1.8)
    return figure


def _draw_vehicles(axes: Axes, rows: pd.DataFrame) -> list[canvas.Array]:
    """Draw the speeds of one platoon and where gaps became negative; return the speeds, m/s."""
    begin = braking_time(rows)
    recent = rows[rows["time_s"] >= begin - _SHOWN_BEFORE]
    last = int(recent["vehicle"].max())
    speeds = []
    for key, of_vehicle in recent.groupby("vehicle", sort=True):
        vehicle = int(float(str(key)))
        colour, width, above = colours.COLOURS["real"], 2.0, 3
        if vehicle > 0:
            colour, width, above = canvas.vehicle_colour(vehicle, last), 1.3, 2
        kept = of_vehicle.iloc[:: -(-len(of_vehicle) // _MOST_POINTS)]
        speed = kept["speed"].to_numpy(dtype=float)
        time = kept["time_s"].to_numpy(dtype=float) - begin
        axes.plot(time, speed, color=colour, linewidth=width, zorder=above)
        speeds.append(speed)
        hit = of_vehicle[of_vehicle["gap"] < 0]
        if len(hit):
            place = (float(hit["time_s"].iloc[0]) - begin, float(hit["speed"].iloc[0]))
            axes.plot(*place, zorder=4, **_COLLISION)
    return speeds


def _speed_range(values: canvas.Array) -> tuple[float, float]:
    """Return the ends of the panels' common axis of speed, m/s."""
    if not len(values):
        return 0.0, 1.0
    margin = 0.04 * max(float(np.ptp(values)), 1.0)
    return float(values.min()) - margin, float(values.max()) + margin


def _handles(collides: bool) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colours.COLOURS["real"], linewidth=2.0, label="leader"),
        Line2D([], [], color=canvas.vehicle_colour(1, 10), linewidth=1.6, label="first follower"),
        Line2D([], [], color=canvas.vehicle_colour(10, 10), linewidth=1.6, label="last follower"),
    ]
    if collides:
        handles.append(Line2D([], [], linestyle="none", label="collision", **_COLLISION))
    return handles


class PlatoonSpeeds(JobFigure):
    """Ten followers behind a leader that brakes."""

    title = "Speeds of ten followers behind a braking leader"
    caption = (
        "All followers use the same method, each behind the vehicle ahead; the leader brakes from"
        " 15 to 7 m/s at 2 m/s², waits 10 s and recovers at 1 m/s². A string stable platoon damps"
        " the disturbance: no vehicle slows down more than the vehicle ahead. One that had not"
        " settled before, or in which vehicles collide, does not count as stable. Dark lines are"
        " the first followers, light ones the last. Of several networks the one is shown whose"
        " last follower becomes slowest."
    )
    order = 90

    def draw(self, result: Result) -> Figure | None:
        """Draws it where platoons were simulated."""
        table = result.tables.get("platoon")
        if table is None:
            return None
        simulated = set(table["method"])
        methods = [method for method in result.shown_methods if method in simulated]
        if not methods:
            return None
        stable = {}
        for method in methods:
            share = result.metrics.get(key_of("platoon/string_stable", method))
            if share is not None:
                stable[method] = share
        return draw_platoons(table, methods, stable)
