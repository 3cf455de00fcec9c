"""SUMO's input for followers behind replayed leaders: parallel single-lane roads, two vehicles on each.

Written by hand, as straight roads need no netconvert. Imports neither torch nor SUMO: the SUMO processes write these files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import quoteattr

ROAD = 1e6
"""Length of a road, m: nobody reaches its end within hours."""

LANE_SPEED = 130.0
"""Speed limit of the roads, m/s: above what any vehicle is allowed itself."""

LEADER, FOLLOWER, LANE = "leader{}", "follower{}", "road{}_0"
"""Names of the vehicles and the lane of road i."""

_APART = 10.0  # m between two roads

Attributes = Mapping[str, float | str]


def network(roads: int) -> str:
    """Returns a network file (`.net.xml`) of parallel roads."""
    box = f"0,0,{ROAD},{_APART * roads}"
    lines = ['<net version="1.20">']
    lines.append(
        f'<location netOffset="0,0" convBoundary="{box}" origBoundary="0,0,1,1" projParameter="!"/>'
    )
    for i in range(roads):
        y = _APART * i
        lines.append(
            f'<edge id="road{i}" from="from{i}" to="to{i}" priority="1"><lane id="{LANE.format(i)}" index="0"'
        )
        lines.append(f' speed="{LANE_SPEED}" length="{ROAD}" shape="0,{y} {ROAD},{y}"/></edge>')
    for i in range(roads):
        y = _APART * i
        lines.append(
            f'<junction id="from{i}" type="dead_end" x="0" y="{y}" incLanes="" intLanes="" shape="0,{y}"/>'
        )
        lines.append(
            f'<junction id="to{i}" type="dead_end" x="{ROAD}" y="{y}" incLanes="{LANE.format(i)}" intLanes=""'
        )
        lines.append(f' shape="{ROAD},{y}"/>')
    return "\n".join([*lines, "</net>"])


class Placed:
    """A vehicle as it enters: its type's attributes, its position, m, and its speed, m/s."""

    def __init__(self, attributes: Attributes, position: float, speed: float) -> None:
        self.attributes = attributes
        self.position = position
        self.speed = speed

    def lines(self, name: str, road: int) -> tuple[str, str]:
        """Returns the elements of its type and of itself. SUMO refuses to insert above what type and lane allow."""
        limit = min(LANE_SPEED, float(self.attributes.get("maxSpeed", LANE_SPEED)))
        given = " ".join(
            f"{key}={quoteattr(_text(value))}" for key, value in self.attributes.items()
        )
        return (
            f'<vType id="type_{name}" speedDev="0" {given}/>',
            f'<vehicle id="{name}" type="type_{name}" route="route{road}" depart="0" insertionChecks="none"'
            f' departPos="{self.position!r}" departSpeed="{max(0.0, min(self.speed, limit))!r}"/>',
        )


def routes(leaders: Sequence[Placed], followers: Sequence[Placed]) -> str:
    """Returns a route file (`.rou.xml`): leader and follower i on road i, both from the first step on."""
    types, vehicles = [], []
    for i, (leader, follower) in enumerate(zip(leaders, followers, strict=True)):
        types.append(f'<route id="route{i}" edges="road{i}"/>')
        for name, vehicle in ((LEADER, leader), (FOLLOWER, follower)):
            kind, placed = vehicle.lines(name.format(i), i)
            types.append(kind)
            vehicles.append(placed)
    return "\n".join(["<routes>", *types, *vehicles, "</routes>"])


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else repr(float(value))
