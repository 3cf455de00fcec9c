"""Scenarios that come with cfx: `cfx drive ring`, `cfx drive motorway`.

`ring` is a single lane of 239 m with 22 vehicles, as in the experiment of Y. Sugiyama et al.
(2008), *Traffic jams without bottlenecks*, New Journal of Physics 10, 033001. `motorway` has six
lanes, an on-ramp and vehicles that make waves. All vehicles to be driven have the vType `car`.

The networks lie in `assets/`. `ring.net.xml` and `town.net.xml` (for `cfx_sumo.drive.stress`) were
made with SUMO's netconvert of a few nodes and edges.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

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
        routes.write_text(self.routes, encoding="utf-8")
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
}
"""The scenarios by name."""
