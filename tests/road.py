"""Stands in for a SUMO simulation, as live drivers meet it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Car:
    speed: float = 10.0
    acceleration: float = 0.0
    length: float = 5.0
    leader: str | None = None
    gap: float = 20.0
    allowed: float = 60.0
    kind: str = "calm"
    told: list[float] = field(default_factory=list)
    mode: int = 31
    decel: float = 4.5
    emergency_decel: float = 9.0
    acts_every: float | None = None


class TraCIException(Exception):  # noqa: N818 - SUMO's name
    """As SUMO's two libraries call it."""


class Road:
    """Stands in for a simulation: vehicles are as tests put them; speeds that are set are kept."""

    def __init__(self, dt: float = 0.1, **cars: Car) -> None:
        self.cars = dict(cars)
        self.time, self.dt = 0.0, dt
        self.departed: list[str] = []
        self.options = {"step-method.ballistic": "false"}
        self.links: list[tuple[Any, ...]] = []
        self.vehicle = self.vehicletype = self.simulation = self.lane = self

    def advance(self) -> None:
        self.time += self.dt

    def getTime(self) -> float:  # noqa: N802 - SUMO's names
        return self.time

    def getDeltaT(self) -> float:  # noqa: N802
        return self.dt

    def getIDList(self) -> tuple[str, ...]:  # noqa: N802
        return tuple(self.cars)

    def getOption(self, name: str) -> str:  # noqa: N802
        return self.options[name]

    def getActionStepLength(self, name: str) -> float:  # noqa: N802
        return self.cars[name].acts_every or self.dt

    def getDepartedIDList(self) -> tuple[str, ...]:  # noqa: N802
        return tuple(self.departed)

    def getLeader(self, name: str, distance: float) -> tuple[str, float] | None:  # noqa: N802
        if name not in self.cars:
            raise TraCIException(f"Vehicle '{name}' is not known.")
        car = self.cars[name]
        return (car.leader, car.gap - 2.5) if car.leader else None

    def getLength(self, name: str) -> float:  # noqa: N802
        """Returns a vehicle's length, m; of a lane the distance to its end, 7 m."""
        return self.cars[name].length if name in self.cars else 7.0

    def getMinGap(self, name: str) -> float:  # noqa: N802
        return 2.5

    def getDecel(self, name: str) -> float:  # noqa: N802
        return self.cars[name].decel

    def getEmergencyDecel(self, name: str) -> float:  # noqa: N802
        return self.cars[name].emergency_decel

    def getStops(self, name: str, limit: int) -> tuple[()]:  # noqa: N802
        return ()

    def getLaneID(self, name: str) -> str:  # noqa: N802
        return "lane"

    def getLanePosition(self, name: str) -> float:  # noqa: N802
        return 0.0

    def getLinks(self, lane: str) -> tuple[()]:  # noqa: N802
        return ()

    def getNextLinks(self, name: str) -> list[tuple[Any, ...]]:  # noqa: N802
        return self.links

    def setDecel(self, name: str, decel: float) -> None:  # noqa: N802
        self.cars[name].kind = self.cars[name].kind.partition("@")[0] + f"@{name}"
        self.cars[name].decel = decel

    def setType(self, name: str, kind: str) -> None:  # noqa: N802
        self.cars[name].kind = kind
        self.cars[name].decel = 4.5

    def setSpeed(self, name: str, speed: float) -> None:  # noqa: N802
        self.cars[name].told.append(speed)

    def setSpeedMode(self, name: str, mode: int) -> None:  # noqa: N802
        self.cars[name].mode = mode

    def __getattr__(self, name: str) -> Any:
        fields = {
            "Speed": "speed",
            "Acceleration": "acceleration",
            "AllowedSpeed": "allowed",
        }
        fields |= {"TypeID": "kind", "SpeedMode": "mode"}
        return lambda vehicle: getattr(self.cars[vehicle], fields[name.removeprefix("get")])


def platoon(count: int, **settings: Any) -> Road:
    return Road(
        lead=Car(),
        **{
            f"v{i}": Car(speed=8.0 + i % 9, gap=15.0 + 3 * (i % 50), leader="lead", **settings)
            for i in range(count)
        },
    )
