"""Situations that go wrong if anything does: `cfx drive stress`.

Thousands of single events run at once in SUMO, each on a road of its own: cut-ins, leaders who
brake as hard as a car can, vehicles that stand on the lane. Then come a dropped lane, a red light,
a queue at a light and the crossing traffic of a town. Every event can be survived by braking at 9
m/s2 at most; a vehicle of the vType `car` should survive it with less.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfx.errors import SumoError
from cfx.plugin import Task, files
from cfx_sumo.drive.queue import SECONDS, QueueAtLight, queue_of
from cfx_sumo.drive.scenarios import ASSETS, CAR, SCENARIOS, STEP_S, Scenario
from cfx_sumo.drive.sumo_process import command_line, started
from cfx_sumo.installed import require_sumo
from cfx_sumo.live.driver import OBEYS_ALL
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.simulation.network import network

_KIND = "car"
"""The vType that policies drive."""

_LENGTH_M = 4.5
_ROAD_M, _APART_M, _LANE_MPS = 6000.0, 12.0, 40.0
_ENDLESS_S = 1e5  # every event ends after a number of steps
_BEGIN_M = 1500.0  # where cars stand at first, with room behind and ahead
_SETTLE_S, _LASTS_S = 8.0, 30.0  # before an event, and after it

_HARDEST = 9.0
"""m/s2: how leaders brake."""

_BEARABLE = 6.0
"""m/s2: what a cut-in needs at least if the driver reacts within a step; 9 can be braked."""


class Event(NamedTuple):
    """One event on a road of its own; SI units.

    Attributes:
        speed: the car's at first.
        ahead: gap to its leader at first, m.
        leader_speed: the leader's, until the event.
        slower: by which share of the car's speed the vehicle is slower that cuts in; None: nobody
            cuts in.
        margin: what its gap has beyond what braking at `_BEARABLE` needs, m.
        headway: at which the leader begins to brake, s; None: it goes on.
    """

    speed: float
    ahead: float
    leader_speed: float
    slower: float | None = None
    margin: float = 0.0
    headway: float | None = None


class _Command(NamedTuple):
    """How SUMO is started: its step, s (None: 0.1 s), and more of its options."""

    step: float | None
    options: tuple[str, ...]


@dataclass
class EventResult:
    """What happened in all events of a kind.

    Attributes:
        kind: of the events.
        number: of events that took place: the vehicle that cut in or braked was the next ahead.
        headway: smallest, median and largest time headway as the events began, s; None where an
            event has no such moment.
        collisions: driven vehicles that hit something.
        hardest_braking: of any driven vehicle, m/s2.
        hardest_acceleration: of any driven vehicle, m/s2.
        smallest_gap: to the vehicle ahead, m, bumper to bumper.
        braked_hard: driven vehicles that braked harder than 4.5 m/s2.
    """

    kind: str
    number: int
    headway: tuple[float, float, float] | None = None
    collisions: int = 0
    hardest_braking: float = 0.0
    hardest_acceleration: float = 0.0
    smallest_gap: float = float("inf")
    braked_hard: int = 0


@dataclass(frozen=True)
class TownResult:
    """What a policy does in town.

    Attributes:
        saturation_flow: what a queue at a light lets through, vehicles an hour of green and lane.
        lost_time: start-up lost time, s.
        standing_gap: in the queue, m.
        outside: share of the steps behind a leader that began outside what the policy has learned
            from, in crossing traffic.
    """

    saturation_flow: float
    lost_time: float
    standing_gap: float
    outside: float


@dataclass(frozen=True)
class StressResult:
    """What `run_stress` found, a result for each kind of event."""

    events: tuple[EventResult, ...]
    town: TownResult

    def to_json(self) -> dict[str, Any]:
        """Returns plain data."""
        return {"events": [asdict(event) for event in self.events], "town": asdict(self.town)}


def run_stress(
    runs: Mapping[str, str | Path],
    *,
    seed: int = 0,
    cut_ins: int = 1000,
    speed_mode: int = OBEYS_ALL,
    step: float | None = None,
    sumo_options: Sequence[str] = (),
) -> StressResult:
    """Drives all events with the policy of the vType `car`.

    Args:
        runs: `car` -> a job's output folder, the id of its MLflow run, or `cfx://NAME`.
        seed: of the events.
        cut_ins: how many; of the other kinds a fifth as many.
        speed_mode: as in `Driver`.
        step: of the simulation, s; None: 0.1 s.
        sumo_options: more of SUMO's own options.

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
    command = _Command(step, tuple(sumo_options))
    results = []
    with Task("Driving stress", len(kinds) + len(_TOWN) + 1) as task:
        for kind, events in kinds.items():
            results.append(_run_events(kind, events, _fleet(runs, speed_mode), command))
            task.advance()
        for kind, routes, end in _TOWN:
            results.append(_run_town(kind, routes, end, _fleet(runs, speed_mode), command))
            task.advance()
        more, town = run_town(runs, speed_mode=speed_mode, step=step, sumo_options=sumo_options)
        task.advance()
    return StressResult((*results, *more), town)


def run_town(
    runs: Mapping[str, str | Path],
    *,
    speed_mode: int = OBEYS_ALL,
    step: float | None = None,
    sumo_options: Sequence[str] = (),
) -> tuple[tuple[EventResult, ...], TownResult]:
    """Drives a queue at a light and the crossing traffic of `cfx drive town`, as `run_stress` does.

    Raises:
        SumoError: SUMO is missing, or stops.
        DataError: a run has no policy that drives unseen drivers.
    """
    command = _Command(step, tuple(sumo_options))
    queue, kinds = QueueAtLight(), (EventResult("a queue at a light", 0), EventResult(_CROSSING, 0))
    _drive(queue_of(), _fleet(runs, speed_mode), SECONDS, kinds[0], queue.act, command)
    kinds[0].number = sum(len(green) for green in queue.headways)
    fleet, seen = _fleet(runs, speed_mode), set[str]()

    def act(sumo: Any, step: int) -> None:  # noqa: ARG001 - the signature of an act
        seen.update(sumo.simulation.getDepartedIDList())

    _drive(SCENARIOS["town"], fleet, _CROSSING_S, kinds[1], act, command)
    kinds[1].number = len(seen)
    counts = fleet.drivers[_KIND].counts
    return kinds, TownResult(
        queue.saturation_flow,
        queue.lost_time,
        float(np.mean(queue.gaps)),
        counts.outside / max(1, counts.steps),
    )


def report_stress(result: StressResult, output: Path | None = None) -> None:
    """Prints a table of the events, and writes it as JSON where `output` is given."""
    from cfx.plugin import console

    table = console.blank_table(
        "event",
        "number",
        "headway at first [s]",
        "collisions",
        "hardest braking [m/s2]",
        "above 4.5 m/s2",
        "hardest acceleration [m/s2]",
        "smallest gap [m]",
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for event in result.events:
        table.add_row(
            event.kind,
            str(event.number),
            _range(event.headway),
            str(event.collisions),
            f"{event.hardest_braking:.2f}",
            str(event.braked_hard),
            f"{event.hardest_acceleration:.2f}",
            f"{event.smallest_gap:.2f}",
        )
    console.print_table(table)
    town = result.town
    print(
        f"A queue at a light lets {town.saturation_flow:.0f} vehicles through an hour of green and"
        f" lane (usual are 1,700 to 2,000), after {town.lost_time:.1f} s of start-up lost time. In"
        f" crossing traffic {town.outside:.0%} of the steps are outside what the policy has"
        " learned from."
    )
    if output is not None:
        files.write_json(output, result.to_json())


def _range(headway: tuple[float, float, float] | None) -> str:
    if headway is None:
        return ""
    return f"{headway[0]:.2f} to {headway[2]:.2f}"


def _fleet(runs: Mapping[str, str | Path], speed_mode: int) -> Fleet:
    return Fleet.load(runs, speed_mode=speed_mode)


def _cut_in(rng: np.random.Generator) -> Event:
    """Returns a cut-in that braking at `_BEARABLE` survives."""
    speed = float(rng.uniform(5.0, 33.0))
    slower, margin = float(rng.uniform(0.0, 0.3)), float(rng.uniform(0.0, 12.0))
    return Event(speed, 4.0 + 1.5 * speed, speed, slower=slower, margin=margin)


def _braking_leader(rng: np.random.Generator) -> Event:
    speed = float(rng.uniform(5.0, 33.0))
    return Event(speed, 4.0 + 1.5 * speed, speed, headway=float(rng.uniform(1.0, 2.5)))


def _standing_vehicle(rng: np.random.Generator) -> Event:
    speed = float(rng.uniform(5.0, 33.0))
    return Event(speed, 150.0 + _SETTLE_S * speed, 0.0)


def _run_events(kind: str, events: list[Event], fleet: Fleet, command: _Command) -> EventResult:
    """Runs events side by side, each on a road of its own."""
    roads = network(len(events), 2, length=_ROAD_M, speed=_LANE_MPS, apart=_APART_M)
    result = EventResult(kind, len(events))

    def act(sumo: Any, step: int) -> None:
        if step == 0:
            _take_hold(sumo, events)
        if step == round(_SETTLE_S / sumo.simulation.getDeltaT()):
            headways = _happen(sumo, events)
            if headways is not None:
                result.number = len(headways)
                result.headway = _spread(headways)

    with tempfile.TemporaryDirectory(prefix="cfx-") as folder:
        net = Path(folder, "stress.net.xml")
        net.write_text(roads, encoding="utf-8")
        scenario = Scenario(kind, _placed(events), net, _ENDLESS_S)
        _drive(scenario, fleet, _SETTLE_S + _LASTS_S, result, act, command)
    return result


def _spread(values: list[float]) -> tuple[float, float, float] | None:
    if not values:
        return None
    return (float(np.min(values)), float(np.median(values)), float(np.max(values)))


def _take_hold(sumo: Any, events: list[Event]) -> None:
    """Lets the vehicles that no policy drives keep their speeds and lanes."""
    vehicle = sumo.vehicle
    for name in vehicle.getIDList():
        vehicle.setLaneChangeMode(name, 0)
        kind, _, number = name.partition(".")
        if kind != _KIND:
            vehicle.setSpeedMode(name, 0)
            vehicle.setSpeed(name, events[int(number)].leader_speed)


def _happen(sumo: Any, events: list[Event]) -> list[float] | None:
    """Lets vehicles cut in and leaders brake.

    A policy has driven for `_SETTLE_S` by now, at a gap and a speed that are its own. So what
    happens is laid out from where the car is at this moment.

    Returns:
        Time headway, s, of each event in which the vehicle that acts is the next ahead of the car;
        None where nobody acts.
    """
    vehicle = sumo.vehicle
    reaction = max(sumo.simulation.getDeltaT(), STEP_S)
    acting: dict[int, str] = {}
    for number, event in enumerate(events):
        car, leader, cutter = f"{_KIND}.{number}", f"leader.{number}", f"cutter.{number}"
        position, speed = vehicle.getLanePosition(car), vehicle.getSpeed(car)
        if event.slower is not None:
            cutter_speed = min((1.0 - event.slower) * speed, event.leader_speed)
            closing = speed - cutter_speed
            gap = 1.0 + closing * reaction + closing**2 / (2.0 * _BEARABLE) + event.margin
            front = position + gap + _LENGTH_M
            # The leader goes on ahead of whoever cuts in, and never slower.
            room = front + _LENGTH_M + 2.0 + event.leader_speed
            if vehicle.getLanePosition(leader) < room:
                vehicle.moveTo(leader, f"road{number}_0", room)
            vehicle.moveTo(cutter, f"road{number}_0", front)
            vehicle.setPreviousSpeed(cutter, cutter_speed)
            vehicle.setSpeed(cutter, cutter_speed)
            acting[number] = cutter
        elif event.headway is not None:
            # The leader takes the car's speed: then braking as hard as it does is enough.
            front = position + 2.0 + event.headway * speed + _LENGTH_M
            vehicle.moveTo(leader, f"road{number}_0", front)
            vehicle.setPreviousSpeed(leader, speed)
            vehicle.slowDown(leader, 0.0, speed / _HARDEST)
            acting[number] = leader
    return _headways(vehicle, acting) if acting else None


def _headways(vehicle: Any, acting: Mapping[int, str]) -> list[float]:
    """Returns headways of the cars whose next vehicle ahead is the one that acts."""
    headways = []
    for number, name in acting.items():
        car = f"{_KIND}.{number}"
        ahead = vehicle.getLeader(car, 200.0)
        if ahead and ahead[0] == name:
            gap = ahead[1] + vehicle.getMinGap(car)
            headways.append(gap / max(vehicle.getSpeed(car), STEP_S))
    return headways


def _drive(
    scenario: Scenario,
    fleet: Fleet,
    seconds: float,
    result: EventResult,
    act: Callable[[Any, int], None],
    command: _Command,
) -> None:
    """Runs a scenario; `act` is given each step, and notes what the driven vehicles do."""
    with tempfile.TemporaryDirectory(prefix="cfx-") as folder:
        configuration = scenario.write(Path(folder))
        line = command_line(configuration, command.options, step=command.step)
        with started(configuration, line, gui=False) as sumo:
            steps = round(seconds / sumo.simulation.getDeltaT())
            _take_steps(sumo, fleet, steps, result, act)


def _take_steps(
    sumo: Any,
    fleet: Fleet,
    steps: int,
    result: EventResult,
    act: Callable[[Any, int], None],
) -> None:
    vehicle, hard = sumo.vehicle, set()
    collided: set[str] = set()
    for step in range(steps):
        sumo.simulationStep()
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


def _placed(events: list[Event]) -> str:
    """Returns the routes and vehicles of events."""
    lines = [
        "<routes>",
        CAR,
        f'<vType id="other" length="{_LENGTH_M}" maxSpeed="60" speedDev="0"/>',
    ]
    for number, event in enumerate(events):
        lines.append(f'<route id="route{number}" edges="road{number}"/>')
        lines.append(_vehicle(_KIND, _KIND, number, 0, event.speed, _BEGIN_M))
        at = _BEGIN_M + event.ahead + _LENGTH_M
        lines.append(_vehicle("leader", "other", number, 0, event.leader_speed, at))
        if event.slower is not None:
            lines.append(_vehicle("cutter", "other", number, 1, event.leader_speed, _BEGIN_M))
    lines.append("</routes>")
    return "\n".join(lines)


def _vehicle(role: str, kind: str, number: int, lane: int, speed: float, at: float) -> str:
    return (
        f'<vehicle id="{role}.{number}" type="{kind}" route="route{number}" depart="0"'
        f' departLane="{lane}" departPos="{at!r}" departSpeed="{speed!r}"'
        ' insertionChecks="none"/>'
    )


_CROSSING, _CROSSING_S = "crossing traffic in town", 300.0

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


def _run_town(kind: str, routes: str, end: float, fleet: Fleet, command: _Command) -> EventResult:
    """Runs one of the scenarios with a flow of cars; an event is a car."""
    result = EventResult(kind, 0)
    seen: set[str] = set()

    def act(sumo: Any, step: int) -> None:  # noqa: ARG001 - the signature of an act
        seen.update(sumo.simulation.getDepartedIDList())

    text = f"<routes>{CAR}{routes}</routes>"
    town = Scenario(kind, text, ASSETS / "town.net.xml", _ENDLESS_S)
    _drive(town, fleet, end, result, act, command)
    result.number = len(seen)
    return result
