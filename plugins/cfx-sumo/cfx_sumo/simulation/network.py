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

Attributes = Mapping[str, float | str]


def network(
    roads: int,
    lanes: int = 1,
    *,
    length: float = ROAD,
    speed: float = LANE_SPEED,
    apart: float = 10.0,
) -> str:
    """Returns a network file (`.net.xml`) of parallel roads.

    Args:
        roads: how many; road i has the edge `roadI`.
        lanes: of each, 3.2 m wide.
        length: of each, m.
        speed: their limit, m/s.
        apart: from one road's first lane to the next one's, m.
    """
    box = f"0,0,{length},{apart * roads}"
    lines = [
        '<net version="1.20">',
        f'<location netOffset="0,0" convBoundary="{box}" origBoundary="0,0,1,1"'
        ' projParameter="!"/>',
    ]
    for i in range(roads):
        lines.append(f'<edge id="road{i}" from="from{i}" to="to{i}" priority="1">')
        for lane in range(lanes):
            at = apart * i + 3.2 * lane
            lines.append(
                f'<lane id="road{i}_{lane}" index="{lane}" speed="{speed}" length="{length}"'
                f' shape="0,{at} {length},{at}"/>'
            )
        lines.append("</edge>")
    for i in range(roads):
        y = apart * i
        arriving = " ".join(f"road{i}_{lane}" for lane in range(lanes))
        end = f'type="dead_end" y="{y}" intLanes=""'
        lines.append(f'<junction id="from{i}" {end} x="0" incLanes="" shape="0,{y}"/>')
        lines.append(
            f'<junction id="to{i}" {end} x="{length}" incLanes="{arriving}" shape="{length},{y}"/>'
        )
    lines.append("</net>")
    return "\n".join(lines)


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
