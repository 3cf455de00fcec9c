"""SUMO's input for followers behind replayed leaders.

It is parallel single-lane roads with two vehicles on each. It is written without SUMO's tools, as
straight roads need no netconvert. This module imports neither torch nor SUMO: the SUMO processes
write these files.
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
    lines = [
        '<net version="1.20">',
        f'<location netOffset="0,0" convBoundary="{box}" origBoundary="0,0,1,1"'
        ' projParameter="!"/>',
    ]
    for i in range(roads):
        lines += _edge(i)
    for i in range(roads):
        lines += _ends(i)
    lines.append("</net>")
    return "\n".join(lines)


def _edge(i: int) -> list[str]:
    y = _APART * i
    return [
        f'<edge id="road{i}" from="from{i}" to="to{i}" priority="1">'
        f'<lane id="{LANE.format(i)}" index="0"',
        f' speed="{LANE_SPEED}" length="{ROAD}" shape="0,{y} {ROAD},{y}"/></edge>',
    ]


def _ends(i: int) -> list[str]:
    """Returns the junctions at which road i begins and ends."""
    y = _APART * i
    return [
        f'<junction id="from{i}" type="dead_end" x="0" y="{y}" incLanes="" intLanes=""'
        f' shape="0,{y}"/>',
        f'<junction id="to{i}" type="dead_end" x="{ROAD}" y="{y}"'
        f' incLanes="{LANE.format(i)}" intLanes=""',
        f' shape="{ROAD},{y}"/>',
    ]


class Placed:
    """A vehicle as it enters: its type's attributes, its position, m, and its speed, m/s."""

    def __init__(self, attributes: Attributes, position: float, speed: float) -> None:
        self.attributes = attributes
        self.position = position
        self.speed = speed

    def lines(self, name: str, road: int) -> tuple[str, str]:
        """Returns the elements of its type and of itself.

        SUMO refuses to insert a vehicle above what its type and the lane allow.
        """
        limit = min(LANE_SPEED, float(self.attributes.get("maxSpeed", LANE_SPEED)))
        speed = max(0.0, min(self.speed, limit))
        given = []
        for key, value in self.attributes.items():
            given.append(f"{key}={quoteattr(_text(value))}")
        return (
            f'<vType id="type_{name}" speedDev="0" {" ".join(given)}/>',
            f'<vehicle id="{name}" type="type_{name}" route="route{road}" depart="0"'
            f' insertionChecks="none" departPos="{self.position!r}" departSpeed="{speed!r}"/>',
        )


def routes(leaders: Sequence[Placed], followers: Sequence[Placed]) -> str:
    """Returns a route file (`.rou.xml`): leader and follower i on road i, from the start on."""
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
