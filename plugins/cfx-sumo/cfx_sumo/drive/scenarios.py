"""Scenarios that come with cfx: `cfx drive ring`, `cfx drive motorway`, `cfx drive town`.

`ring` is a single lane of 239 m with 22 vehicles, as in the experiment of Y. Sugiyama et al.
(2008), *Traffic jams without bottlenecks*, New Journal of Physics 10, 033001. `motorway` has six
lanes, an on-ramp and vehicles that make waves. `town` has nine junctions with lights, at which
vehicles that turn left give way to those that come towards them, and a roundabout. All vehicles to
be driven have the vType `car`.

The networks lie in `assets/`. `ring.net.xml` and `town.net.xml` (for `cfx_sumo.drive.stress`) were
made with SUMO's netconvert of a few nodes and edges, `streets.net.xml` besides with netgenerate.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from cfx_sumo.demo.motorway import SHIPPED as MOTORWAY

ASSETS = Path(__file__).resolve().parent.parent / "assets"

STEP_S = 0.1
"""Time step of all scenarios, as that of the recordings, unless the user says otherwise."""

CAR = (
    '<vType id="car" accel="2.6" decel="4.5" emergencyDecel="9" sigma="0" tau="1" minGap="2.5"'
    ' length="4.5" maxSpeed="40" speedDev="0"/>'
)
"""SUMO's passenger car without its randomness; where nothing is ahead it drives as SUMO has it."""

_CARS_ON_RING = 22
_RING_M = (119.29, 119.31)  # lengths of the two halves

_WAVE_S = (40.0, 12.0)
"""Every so many seconds a wave begins, and how long its slow part lasts, s."""

_WAVE_MPS = 7.0
_WAVE_DECELERATION, _WAVE_ACCELERATION = 2.0, 1.0


class Scenario(NamedTuple):
    """One scenario.

    Attributes:
        summary: one sentence.
        routes: the route file's text.
        network: the network's file.
        end: s, unless the user says otherwise.
        make_actor: returns what acts on the simulation before each step; None: nothing does.
    """

    summary: str
    routes: str
    network: Path
    end: float
    make_actor: Callable[[], Callable[[Any], None]] | None = None

    def write(self, folder: Path, end: float | None = None) -> Path:
        """Writes the scenario's files into a folder; returns SUMO's configuration.

        Args:
            folder: that is there.
            end: s; None: the scenario's own.
        """
        last = self.end
        if end is not None:
            last = end
        routes = folder / "scenario.rou.xml"
        routes.write_text(in_order_of_departure(self.routes), encoding="utf-8")
        configuration = folder / "scenario.sumocfg"
        configuration.write_text(
            f'<configuration><input><net-file value="{self.network}"/>'
            f'<route-files value="{routes}"/></input>'
            f'<time><end value="{last:g}"/><step-length value="{STEP_S:g}"/></time>'
            '<processing><collision.action value="warn"/>'
            '<collision.mingap-factor value="0"/><time-to-teleport value="-1"/>'
            "</processing></configuration>",
            encoding="utf-8",
        )
        return configuration


def in_order_of_departure(routes: str) -> str:
    """Sorts the vehicles and flows of a route file, after its types and routes.

    SUMO reads a route file while it simulates, and ignores whatever departs before an entry above.

    Args:
        routes: the route file's text, with departures as plain numbers, s.
    """
    root = ElementTree.fromstring(routes)  # noqa: S314 - it is cfx's own text

    def departure(entry: ElementTree.Element) -> float:
        return float(entry.get("begin", entry.get("depart", "-inf")))

    root[:] = sorted(root, key=departure)
    return ElementTree.tostring(root, encoding="unicode")


class Waves:
    """Slows down each vehicle of type `wave` now and then, and lets it go again."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}
        self._next: dict[str, float] = {}

    def __call__(self, connection: Any) -> None:
        now, vehicle = connection.simulation.getTime(), connection.vehicle
        step = connection.simulation.getDeltaT()
        every, lasts = _WAVE_S
        for name in vehicle.getIDList():
            if not name.startswith("wave"):
                continue
            begins = self._next.setdefault(name, now + every / 2)
            if now >= begins:
                needed = max(0.0, vehicle.getSpeed(name) - _WAVE_MPS) / _WAVE_DECELERATION
                vehicle.slowDown(name, _WAVE_MPS, needed + step)
                self._until[name] = now + needed + lasts
                self._next[name] = now + needed + lasts + every
            elif self._until.get(name, now + 1.0) <= now:
                allowed = vehicle.getAllowedSpeed(name)
                needed = max(0.0, allowed - vehicle.getSpeed(name)) / _WAVE_ACCELERATION
                vehicle.slowDown(name, allowed, needed + step)
                del self._until[name]


def _ring_routes() -> str:
    lines = [
        "<routes>",
        CAR,
        '<route id="from_north" edges="north south" repeat="10000"/>',
        '<route id="from_south" edges="south north" repeat="10000"/>',
    ]
    apart = sum(_RING_M) / _CARS_ON_RING
    for number in range(_CARS_ON_RING):
        at, route = number * apart, "from_north"
        if at >= _RING_M[0]:
            at, route = at - _RING_M[0], "from_south"
        lines.append(
            f'<vehicle id="car{number}" type="car" route="{route}" depart="0" departPos="{at:.2f}"'
            ' departSpeed="2" insertionChecks="none"/>'
        )
    lines.append("</routes>")
    return "\n".join(lines)


_MOTORWAY_ROUTES = f"""<routes>
{CAR}
<vType id="wave" accel="1.5" decel="3" emergencyDecel="9" sigma="0" tau="1.2" length="4.5"
  maxSpeed="22" speedDev="0" lcSpeedGain="0" color="255,0,0"/>
<route id="through" edges="1001 1002 1003"/>
<route id="ramp" edges="1004 1002 1003"/>
<flow id="car" type="car" route="through" begin="0" end="100000" vehsPerHour="5400"
  departLane="free" departSpeed="avg"/>
<flow id="joining" type="car" route="ramp" begin="0" end="100000" vehsPerHour="400"
  departSpeed="12"/>
<flow id="wave" type="wave" route="through" begin="5" end="100000" vehsPerHour="360"
  departLane="random" departSpeed="20"/>
</routes>"""

_ARMS = 4
"""Of the roundabout."""

_STREETS = 3
"""Streets of the town in each direction."""


def _town_routes() -> str:
    lines = ["<routes>", CAR]
    flows: list[tuple[str, str, int]] = []
    for number in range(_STREETS):
        last, row = chr(ord("A") + _STREETS - 1), chr(ord("A") + number)
        west, east = (f"left{number}", f"A{number}"), (f"right{number}", f"{last}{number}")
        south = (f"bottom{number}", f"{row}0")
        north = (f"top{number}", f"{row}{_STREETS - 1}")
        for (begin, enters), (end, leaves) in ((west, east), (south, north)):
            flows.append((begin + enters, leaves + end, 300))
            flows.append((end + leaves, enters + begin, 300))
        flows.append((west[0] + west[1], north[1] + north[0], 60))
        flows.append((east[0] + east[1], south[1] + south[0], 60))
        flows.append((south[0] + south[1], west[1] + west[0], 60))
        flows.append((north[0] + north[1], east[1] + east[0], 60))
    for arm in range(_ARMS):
        flows.append((f"in{arm}", f"out{(arm + 2) % _ARMS}", 240))
        flows.append((f"in{arm}", f"out{(arm + 3) % _ARMS}", 80))
    for number, (begin, end, rate) in enumerate(flows):
        lines.append(
            f'<flow id="car{number}" type="car" from="{begin}" to="{end}" begin="{number % 12}"'
            f' end="100000" vehsPerHour="{rate}" departSpeed="desired"/>'
        )
    lines.append("</routes>")
    return "\n".join(lines)


SCENARIOS = {
    "ring": Scenario(
        f"{_CARS_ON_RING} vehicles on a ring of {sum(_RING_M):.0f} m",
        _ring_routes(),
        ASSETS / "ring.net.xml",
        300.0,
    ),
    "motorway": Scenario(
        "six lanes, an on-ramp, lane changes, and vehicles that make waves",
        _MOTORWAY_ROUTES,
        MOTORWAY,
        300.0,
        Waves,
    ),
    "town": Scenario(
        "nine junctions with lights and crossing traffic, and a roundabout",
        _town_routes(),
        ASSETS / "streets.net.xml",
        600.0,
    ),
}
"""The scenarios by name."""
