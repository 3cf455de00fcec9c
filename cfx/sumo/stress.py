"""Situations that go wrong if anything does: `cfx drive stress`.

Thousands of single events run at once in SUMO, each on a road of its own: cut-ins, leaders who
brake as hard as a car can, vehicles that stand on the lane. Then come a dropped lane and a red
light. Every event can be survived by braking at 9 m/s2 at most; a vehicle of the vType `car` should
survive it with less.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfx.errors import SumoError
from cfx.files import write_json
from cfx.progress import Task
from cfx.simulators.sumo.installed import require_sumo
from cfx.sumo.drive import started
from cfx.sumo.fleet import Fleet
from cfx.sumo.scenarios import ASSETS, CAR, STEP_S

_KIND = "car"
"""The vType that policies drive."""

_LENGTH_M = 4.5
_ROAD_M, _APART_M, _LANE_MPS = 6000.0, 12.0, 40.0
_BEGIN_M = 1500.0  # where cars stand at first, with room behind and ahead
_SETTLE_S, _LASTS_S = 8.0, 30.0  # before an event, and after it

_BEARABLE = 6.0
"""m/s2: what a cut-in needs at least if the driver reacts within a step; 9 can be braked."""


class Vehicle(NamedTuple):
    """A vehicle that no policy drives: where it begins, and its speeds.

    Attributes:
        lane: 0 is the driven car's.
        ahead: gap to the car at first, m; the cutter's counts from the moment of its cut-in.
        speed: m/s.
    """

    lane: int
    ahead: float
    speed: float


class Event(NamedTuple):
    """One event on a road of its own; SI units.

    Attributes:
        speed: the car's at first.
        leader: whom it follows at first; None: nobody.
        cutter: who cuts in; None: nobody.
        braking: deceleration to a standstill of the leader; 0: it goes on.
    """

    speed: float
    leader: Vehicle | None = None
    cutter: Vehicle | None = None
    braking: float = 0.0


@dataclass
class EventResult:
    """What happened in all events of a kind.

    Attributes:
        kind: of the events.
        number: of events.
        collisions: driven vehicles that hit something.
        hardest_braking: of any driven vehicle, m/s2.
        hardest_acceleration: of any driven vehicle, m/s2.
        smallest_gap: to the vehicle ahead, m, bumper to bumper.
        braked_hard: driven vehicles that braked harder than 4.5 m/s2.
    """

    kind: str
    number: int
    collisions: int = 0
    hardest_braking: float = 0.0
    hardest_acceleration: float = 0.0
    smallest_gap: float = float("inf")
    braked_hard: int = 0


@dataclass(frozen=True)
class StressResult:
    """What `run_stress` found, a result for each kind of event."""

    events: tuple[EventResult, ...]

    def to_json(self) -> dict[str, Any]:
        """Returns plain data."""
        return {"events": [asdict(one) for one in self.events]}


def run_stress(
    runs: Mapping[str, str | Path], *, seed: int = 0, cut_ins: int = 1000, speed_mode: int = 31
) -> StressResult:
    """Drives all events with the policy of the vType `car`.

    Args:
        runs: `car` -> a job's output folder, the id of its MLflow run, or `cfx://NAME`.
        seed: of the events.
        cut_ins: how many; of the other kinds a fifth as many.
        speed_mode: as in `Driver`.

    Raises:
        SumoError: SUMO is missing, or another vType than `car` is given.
        DataError: a run has no policy that drives unseen drivers.
    """
    require_sumo()
    if set(runs) != {_KIND}:
        raise SumoError(f"the stress scenario drives vType '{_KIND}' alone: --drivers {_KIND}=RUN")
    rng = np.random.default_rng(seed)
    few = max(1, cut_ins // 5)
    kinds = {
        "cut-ins": [_cut_in(rng) for _ in range(cut_ins)],
        "leaders braking at 9 m/s2": [_braking_leader(rng) for _ in range(few)],
        "standing vehicles": [_standing_vehicle(rng) for _ in range(few)],
    }
    found = []
    with Task("Driving stress", len(kinds) + 2) as task:
        for kind, events in kinds.items():
            found.append(_run_events(kind, events, _fleet(runs, speed_mode)))
            task.advance()
        for kind, routes, end in _TOWN:
            found.append(_run_town(kind, routes, end, _fleet(runs, speed_mode)))
            task.advance()
    return StressResult(tuple(found))


def report_stress(result: StressResult, output: Path | None = None) -> None:
    """Prints a table of the events, and writes it as JSON where `output` is given."""
    from cfx.console import blank_table, put

    table = blank_table(
        "event",
        "number",
        "collisions",
        "hardest braking [m/s2]",
        "above 4.5 m/s2",
        "hardest acceleration [m/s2]",
        "smallest gap [m]",
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for one in result.events:
        table.add_row(
            one.kind,
            str(one.number),
            str(one.collisions),
            f"{one.hardest_braking:.2f}",
            str(one.braked_hard),
            f"{one.hardest_acceleration:.2f}",
            f"{one.smallest_gap:.2f}",
        )
    put(table)
    if output is not None:
        write_json(output, result.to_json())


def _fleet(runs: Mapping[str, str | Path], speed_mode: int) -> Fleet:
    return Fleet.load(runs, speed_mode=speed_mode)


def _cut_in(rng: np.random.Generator) -> Event:
    """Returns a cut-in that braking at `_BEARABLE` survives."""
    speed = float(rng.uniform(5.0, 33.0))
    slower = float(rng.uniform(0.0, 0.3) * speed)
    needed = 1.0 + slower * STEP_S + slower**2 / (2.0 * _BEARABLE)
    gap = needed + float(rng.uniform(0.0, 12.0))
    leader = Vehicle(0, 4.0 + 1.5 * speed, speed)
    return Event(speed, leader, Vehicle(1, gap, speed - slower))


def _braking_leader(rng: np.random.Generator) -> Event:
    speed = float(rng.uniform(5.0, 33.0))
    headway = float(rng.uniform(1.0, 2.5))
    return Event(speed, Vehicle(0, 2.0 + headway * speed, speed), braking=9.0)


def _standing_vehicle(rng: np.random.Generator) -> Event:
    speed = float(rng.uniform(5.0, 33.0))
    ahead = 150.0 + _SETTLE_S * speed
    return Event(speed, Vehicle(0, ahead, 0.0))


def _run_events(kind: str, events: list[Event], fleet: Fleet) -> EventResult:
    """Runs events side by side, each on a road of its own."""
    network, routes = _roads(len(events)), _placed(events)
    events_at = round(_SETTLE_S / STEP_S)
    steps = events_at + round(_LASTS_S / STEP_S)
    result = EventResult(kind, len(events))

    def act(sumo: Any, step: int) -> None:
        if step == 0:
            _take_hold(sumo, events)
        if step == events_at:
            _happen(sumo, events)

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-")))
        configuration = _written(folder, network, routes)
        sumo = stack.enter_context(started(configuration, _command(configuration), gui=False))
        _drive(sumo, fleet, steps, result, act)
    return result


def _take_hold(sumo: Any, events: list[Event]) -> None:
    """Lets the vehicles that no policy drives keep their speeds and lanes."""
    vehicle = sumo.vehicle
    for name in vehicle.getIDList():
        vehicle.setLaneChangeMode(name, 0)
        if name.startswith(_KIND):
            continue
        kind, _, number = name.partition(".")
        other = getattr(events[int(number)], kind)
        vehicle.setSpeedMode(name, 0)
        vehicle.setSpeed(name, other.speed)


def _happen(sumo: Any, events: list[Event]) -> None:
    """Lets cutters cut in and leaders brake."""
    vehicle = sumo.vehicle
    for number, event in enumerate(events):
        if event.cutter is not None:
            position = vehicle.getLanePosition(f"{_KIND}.{number}") + event.cutter.ahead + _LENGTH_M
            vehicle.moveTo(f"cutter.{number}", f"road{number}_0", position)
        if event.braking > 0 and event.leader is not None:
            lasts = event.leader.speed / event.braking
            vehicle.slowDown(f"leader.{number}", 0.0, lasts)


def _drive(
    sumo: Any,
    fleet: Fleet,
    steps: int,
    result: EventResult,
    act: Callable[[Any, int], None] | None = None,
) -> None:
    """Runs a simulation and notes what the driven vehicles do."""
    vehicle, hard = sumo.vehicle, set()
    collided: set[str] = set()
    for step in range(steps):
        sumo.simulationStep()
        if act is not None:
            act(sumo, step)
        fleet.step(sumo)
        collided |= set(sumo.simulation.getCollidingVehiclesIDList())
        for name in fleet.vehicles:
            acceleration = vehicle.getAcceleration(name)
            result.hardest_braking = max(result.hardest_braking, -acceleration)
            result.hardest_acceleration = max(result.hardest_acceleration, acceleration)
            if acceleration < -4.5 - 1e-6:
                hard.add(name)
            leader = vehicle.getLeader(name, 50.0)
            if leader and leader[0]:
                gap = leader[1] + vehicle.getMinGap(name)
                result.smallest_gap = min(result.smallest_gap, gap)
                if gap < 0:
                    collided.add(name)
    result.braked_hard = len(hard)
    result.collisions = len({name for name in collided if name.startswith(_KIND)})


def _command(configuration: Path) -> list[str]:
    command = ["sumo", "-c", str(configuration), "--collision.action", "warn"]
    # Contact is a collision; SUMO's own rule takes a gap below minGap for one.
    command += ["--collision.mingap-factor", "0"]
    for name in ("--no-step-log", "--duration-log.disable", "--no-warnings"):
        command += [name, "true"]
    return command


def _written(folder: Path, network: str | Path, routes: str) -> Path:
    """Writes a scenario; the network is a text, or a file that is there already."""
    if isinstance(network, str):
        text, network = network, folder / "stress.net.xml"
        network.write_text(text, encoding="utf-8")
    (folder / "stress.rou.xml").write_text(routes, encoding="utf-8")
    configuration = folder / "stress.sumocfg"
    configuration.write_text(
        f'<configuration><input><net-file value="{network}"/>'
        f'<route-files value="{folder / "stress.rou.xml"}"/></input>'
        f'<time><step-length value="{STEP_S:g}"/></time>'
        '<processing><time-to-teleport value="-1"/></processing></configuration>',
        encoding="utf-8",
    )
    return configuration


def _roads(number: int) -> str:
    """Returns a network of parallel roads with two lanes each."""
    box = f"0,0,{_ROAD_M},{_APART_M * number}"
    lines = [
        '<net version="1.20">',
        f'<location netOffset="0,0" convBoundary="{box}" origBoundary="0,0,1,1"'
        ' projParameter="!"/>',
    ]
    ends = []
    for i in range(number):
        y = _APART_M * i
        lanes = []
        for lane in range(2):
            at = y + 3.2 * lane
            lanes.append(
                f'<lane id="road{i}_{lane}" index="{lane}" speed="{_LANE_MPS}" length="{_ROAD_M}"'
                f' shape="0,{at} {_ROAD_M},{at}"/>'
            )
        lines.append(
            f'<edge id="road{i}" from="from{i}" to="to{i}" priority="1">{"".join(lanes)}</edge>'
        )
        ends.append(
            f'<junction id="from{i}" type="dead_end" x="0" y="{y}" incLanes="" intLanes=""'
            f' shape="0,{y}"/>'
        )
        ends.append(
            f'<junction id="to{i}" type="dead_end" x="{_ROAD_M}" y="{y}"'
            f' incLanes="road{i}_0 road{i}_1" intLanes="" shape="{_ROAD_M},{y}"/>'
        )
    return "\n".join([*lines, *ends, "</net>"])


def _placed(events: list[Event]) -> str:
    """Returns the routes and vehicles of events."""
    lines = [
        "<routes>",
        CAR,
        f'<vType id="other" length="{_LENGTH_M}" maxSpeed="60" speedDev="0"/>',
    ]
    for number, event in enumerate(events):
        lines.append(f'<route id="route{number}" edges="road{number}"/>')
        lines.append(_vehicle(_KIND, _KIND, number, Vehicle(0, 0.0, event.speed), _BEGIN_M))
        if event.leader is not None:
            at = _BEGIN_M + event.leader.ahead + _LENGTH_M
            lines.append(_vehicle("leader", "other", number, event.leader, at))
        if event.cutter is not None:
            lines.append(_vehicle("cutter", "other", number, event.cutter, _BEGIN_M))
    lines.append("</routes>")
    return "\n".join(lines)


def _vehicle(role: str, kind: str, number: int, vehicle: Vehicle, at: float) -> str:
    return (
        f'<vehicle id="{role}.{number}" type="{kind}" route="route{number}" depart="0"'
        f' departLane="{vehicle.lane}" departPos="{at!r}" departSpeed="{vehicle.speed!r}"'
        ' insertionChecks="none"/>'
    )


_TOWN = (
    (
        "a lane drop",
        '<route id="r" edges="wide narrow"/><flow id="car" type="car" route="r" begin="0" end="500"'
        ' vehsPerHour="2600" departLane="random" departSpeed="desired" departPos="base"/>',
        600.0,
    ),
    (
        "a red light",
        '<route id="r" edges="before after"/><flow id="car" type="car" route="r" begin="0"'
        ' end="500" vehsPerHour="700" departSpeed="desired"/>',
        600.0,
    ),
)
"""Kind, demand and duration, s, of the events in `assets/town.net.xml`."""


def _run_town(kind: str, routes: str, end: float, fleet: Fleet) -> EventResult:
    """Runs one of the scenarios with a flow of cars; an event is a car."""
    result = EventResult(kind, 0)
    seen: set[str] = set()

    def act(sumo: Any, step: int) -> None:  # noqa: ARG001 - the signature of an act
        seen.update(sumo.simulation.getDepartedIDList())

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-")))
        text = f"<routes>{CAR}{routes}</routes>"
        configuration = _written(folder, ASSETS / "town.net.xml", text)
        sumo = stack.enter_context(started(configuration, _command(configuration), gui=False))
        _drive(sumo, fleet, round(end / STEP_S), result, act)
    result.number = len(seen)
    return result
