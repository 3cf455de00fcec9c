"""`cfx drive SCENARIO --report FOLDER`: flows, headways and time-space diagrams of a scenario.

The scenario is driven twice: by the policies, and by SUMO's own models. Both are looked at once a
second.

Shapes: N observations of vehicles.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfx.errors import OutputError

EVERY_S = 1.0
"""s: between two looks at the vehicles."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Observations(NamedTuple):
    """Where vehicles were, `(N,)` each, by vehicle and then by time.

    Attributes:
        lanes: names of the lanes.
        lane: which of them.
        vehicle: number of the vehicle.
        time: s.
        position: of the front on the lane, m.
        speed: m/s.
        seconds: how long was looked.
    """

    lanes: tuple[str, ...]
    lane: Ints
    vehicle: Ints
    time: Floats
    position: Floats
    speed: Floats
    seconds: float


class Observer:
    """Notes where all vehicles of a simulation are, once a second."""

    def __init__(self) -> None:
        self._lanes: dict[str, int] = {}
        self._vehicles: dict[str, int] = {}
        self._rows: list[tuple[float, ...]] = []
        self._next = -np.inf
        self._first: float | None = None
        self._last = 0.0

    def look(self, sumo: Any) -> None:
        """Looks at the vehicles after a step of the simulation."""
        now = sumo.simulation.getTime()
        if self._first is None:
            self._first = now
        self._last = now
        if now < self._next - 1e-6:
            return
        self._next = now + EVERY_S
        vehicle = sumo.vehicle
        for name in vehicle.getIDList():
            lane = vehicle.getLaneID(name)
            if not lane or lane.startswith(":"):
                continue  # teleporting, or within a junction, where lanes cross
            place = vehicle.getLanePosition(name)
            numbers = (
                self._lanes.setdefault(lane, len(self._lanes)),
                self._vehicles.setdefault(name, len(self._vehicles)),
            )
            self._rows.append((*numbers, now, place, vehicle.getSpeed(name)))

    def observations(self) -> Observations:
        """Returns what was noted."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 5)
        rows = rows[np.lexsort((rows[:, 2], rows[:, 1]))]
        lane, vehicle, time, position, speed = rows.T
        seconds = self._last - (self._first or 0.0) + EVERY_S
        return Observations(
            tuple(self._lanes),
            lane.astype(np.int64),
            vehicle.astype(np.int64),
            time,
            position,
            speed,
            seconds,
        )


class LaneFlow(NamedTuple):
    """Traffic of one lane.

    Attributes:
        lane: its name.
        flow: vehicles/h that pass the middle of where vehicles were on it.
        speed: in the mean over vehicles' time, m/s.
        headways: s, between vehicles that pass this place one after the other.
    """

    lane: str
    flow: float
    speed: float
    headways: Floats


def lane_flows(observations: Observations) -> dict[str, LaneFlow]:
    """Returns the traffic of each lane.

    When a vehicle passes a place follows from where it was a second before and after, at a constant
    speed in between.
    """
    flows = {}
    vehicle, lane, time = observations.vehicle, observations.lane, observations.time
    # Whether the next observation is of the same vehicle in the same lane, `(N - 1,)`.
    goes_on = (vehicle[1:] == vehicle[:-1]) & (lane[1:] == lane[:-1])
    goes_on &= np.diff(time) < 1.5 * EVERY_S
    before, after = observations.position[:-1], observations.position[1:]
    for number, name in enumerate(observations.lanes):
        on_lane = lane == number
        position = observations.position[on_lane]
        middle = 0.5 * (float(position.min()) + float(position.max()))
        passes = goes_on & on_lane[1:] & (before < middle) & (middle <= after)
        share = (middle - before[passes]) / (after[passes] - before[passes])
        times = np.sort(time[:-1][passes] + share * np.diff(time)[passes])
        flows[name] = LaneFlow(
            name,
            3600.0 * len(times) / max(observations.seconds, EVERY_S),
            float(observations.speed[on_lane].mean()),
            np.diff(times),
        )
    return flows


class ScenarioReport(NamedTuple):
    """A scenario with drivers of cfx, and with SUMO's own models alone."""

    driven: Observations
    plain: Observations


def busiest_lane(observations: Observations) -> str | None:
    """Returns the lane on which vehicles spent most time; None if there were no vehicles."""
    if not len(observations.lane):
        return None
    return observations.lanes[int(np.bincount(observations.lane).argmax())]


def write_report(report: ScenarioReport, folder: Path) -> list[Path]:
    """Writes `lanes.csv`, `headways.csv` and `report.png` into a folder.

    Raises:
        OutputError: the folder cannot be written.
    """
    by_run = {"cfx": lane_flows(report.driven), "sumo": lane_flows(report.plain)}
    lanes = sorted(set(by_run["cfx"]) | set(by_run["sumo"]))
    rows = []
    headways: list[list[object]] = []
    for lane in lanes:
        row: list[object] = [lane]
        for run, flows in by_run.items():
            lane_flow = flows.get(lane)
            if lane_flow is None:
                row += ["", ""]
                continue
            row += [round(lane_flow.flow, 1), round(lane_flow.speed, 3)]
            for headway in lane_flow.headways.tolist():
                headways.append([run, lane, round(headway, 3)])
        rows.append(row)
    columns = ["lane", "cfx_flow", "cfx_speed_mps", "sumo_flow", "sumo_speed_mps"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / "lanes.csv", columns, rows)
        _write(folder / "headways.csv", ["run", "lane", "headway_s"], headways)
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written ({error.strerror}); name another --report"
        ) from error
    # Its imports take seconds, and nothing else here draws.
    from cfx.plugin import drawing
    from cfx_sumo.drive.report_figure import draw_report

    picture = drawing.write_figure(draw_report(report), folder / "report.png")
    return [folder / "lanes.csv", folder / "headways.csv", picture]


def _write(path: Path, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)
