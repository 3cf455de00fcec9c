"""What a standing queue lets through at a light: saturation flow and start-up lost time.

Transportation Research Board (2016), *Highway Capacity Manual*, 6th edition, chapter 31: headways
are taken as the vehicles of the queue cross the stop line; those of the fifth and later give the
saturation flow, and what the first four take longer is the start-up lost time.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from cfx_sumo.drive.scenarios import ASSETS, CAR, Scenario

SECONDS = 630.0
"""Five cycles of the light after two in which the queue fills."""

_LANE, _LIGHT = "before_0", "light"
_RED, _GREEN = 0, 2
"""Phases of the light in which the lane's red and green begin."""

_FILLED_S = 180.0
_QUEUED_MPS, _STANDS_MPS = 1.0, 0.1
"""Speeds below which a vehicle belongs to the queue, and stands, as the light turns green."""

_STARTING = 4
"""First vehicles of a queue, whose headways are longer than the saturation flow's."""


def queue_of(kind: str = CAR) -> Scenario:
    """Returns more cars at a light of a lane (60 km/h, 41 s of green in 90 s) than it lets through.

    Args:
        kind: the vType `car`.
    """
    routes = (
        f'<routes>{kind}<route id="r" edges="before after"/><flow id="car" type="car" route="r"'
        ' begin="0" end="100000" vehsPerHour="1800" departSpeed="desired"/></routes>'
    )
    return Scenario("a queue at a light", routes, ASSETS / "town.net.xml", 1e5)


class QueueAtLight:
    """Takes the headways of the vehicles that leave a queue.

    Attributes:
        headways: of each green, s: the first vehicle's since the light turned green, then those
            between vehicles.
        gaps: at standstill, m, bumper to bumper.
    """

    def __init__(self) -> None:
        self.headways: list[list[float]] = []
        self.gaps: list[float] = []
        self._phase: int | None = None
        self._on: set[str] = set()
        self._queue: list[str] = []
        self._crossed: list[float] | None = None

    def act(self, sumo: Any, step: int) -> None:
        """Looks at the queue after a step of the simulation."""
        now = sumo.simulation.getTime()
        on = set(sumo.lane.getLastStepVehicleIDs(_LANE))
        phase = sumo.trafficlight.getPhase(_LIGHT)
        if phase != self._phase:
            if phase == _GREEN and now > _FILLED_S:
                self._crossed = [now]
                self._queue = self._standing(sumo.vehicle, on)
            if phase == _RED and self._crossed is not None:
                self.headways.append(np.diff(self._crossed).tolist())
                self._crossed = None
            self._phase = phase
        if self._crossed is not None:
            crossed = (self._on - on).intersection(self._queue)
            self._crossed += [now] * len(crossed)
        self._on = on

    def _standing(self, vehicle: Any, on: set[str]) -> list[str]:
        """Returns the queue, first vehicle first, and notes its gaps."""
        queue = [name for name in sorted(on) if vehicle.getSpeed(name) < _QUEUED_MPS]
        queue.sort(key=vehicle.getLanePosition, reverse=True)
        for ahead, behind in pairwise(queue):
            if vehicle.getSpeed(behind) < _STANDS_MPS:
                rear = vehicle.getLanePosition(ahead) - vehicle.getLength(ahead)
                self.gaps.append(rear - vehicle.getLanePosition(behind))
        return queue

    @property
    def is_measured(self) -> bool:
        """Whether more than `_STARTING` vehicles left a queue in one green."""
        return any(len(green) > _STARTING for green in self.headways)

    @property
    def _saturated(self) -> float:
        """The mean headway of the fifth vehicles and later, s."""
        later = [green[_STARTING:] for green in self.headways]
        return float(np.mean(np.concatenate(later)))

    @property
    def saturation_flow(self) -> float:
        """Vehicles an hour of green."""
        return 3600.0 / self._saturated

    @property
    def lost_time(self) -> float:
        """What the first four vehicles take longer than four others, s."""
        first = [sum(green[:_STARTING]) for green in self.headways]
        return float(np.mean(first)) - _STARTING * self._saturated
