"""`cfx drive`: runs a user's SUMO scenario with live drivers for some of its vTypes.

SUMO runs in this process (libsumo), so nothing here may load pyarrow, with which it does not get
on.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import NDArray

from cfx.errors import DataError, OutputError, SumoError, nearest
from cfx.plugin import Task
from cfx_sumo.drive.distributions import members_of
from cfx_sumo.drive.left_out import left_out
from cfx_sumo.drive.scenario_report import Observer, ScenarioReport, write_report
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.drive.sumo_process import command_line, is_set, started
from cfx_sumo.drive.tally import Collision, CollisionCounts, ScenarioRun, Tally
from cfx_sumo.drive.vehicle_rows import VehicleRows
from cfx_sumo.installed import require_sumo
from cfx_sumo.live.driver import Driver, DriverOptions
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.live.histories import WALKING_MPS
from cfx_sumo.live.surroundings import View, lanes_of

Actor = Callable[[Any], None]
"""Acts on a simulation before each of its steps."""

_LANES_EVERY_S = 0.5
"""s: lanes are looked at no more often, as SUMO has to be asked for each vehicle."""


def run_scenario(
    scenario: Path | str,
    runs: Mapping[str, str | Path],
    *,
    end: float | None = None,
    step: float | None = None,
    output: Path | None = None,
    report_to: Path | None = None,
    gui: bool = False,
    sumo_options: Sequence[str] = (),
    **options: Unpack[DriverOptions],
) -> ScenarioRun:
    """Runs a scenario in libsumo, or in SUMO's window, until it is over.

    It is over when no vehicle is on the road or still to come, at the end that the scenario gives,
    or at `end`. A vehicle that arrives, teleports, collides or changes lanes ends nothing: it is
    counted, and goes on with what SUMO makes of it (one that teleported begins anew).

    Args:
        scenario: SUMO's configuration (`.sumocfg`), or the name of a scenario that comes with cfx
            (`cfx_sumo.drive.scenarios`).
        runs: vType or vTypeDistribution -> a job's output folder, the id of its MLflow run, or a
            ready-made policy (`cfx://NAME`).
        end: s of simulated time.
        step: of the simulation, s; None: the scenario's, or that of the policies where it has none.
        output: a CSV file with a row for each driven vehicle and step.
        report_to: a folder for flows, headways and time-space diagrams, beside those of the same
            scenario with SUMO's own models (`cfx_sumo.drive.scenario_report`); None: none.
        gui: show SUMO's window, slowly enough to watch.
        sumo_options: more of SUMO's own options.
        options: as in `DriverOptions`; the seed is also SUMO's, without one it is the scenario's.

    Raises:
        SumoError: SUMO is missing, refuses the scenario or stops; a vType is not in it or never on
            the road; the steps differ.
        DataError: a run has no policy that drives unseen drivers, or the scenario is not there.
        OutputError: the output cannot be written.
    """
    require_sumo()
    with ExitStack() as stack:
        path, make_actor = _prepared(scenario, end, stack)
        seed = options.get("seed")
        options["seed"] = seed or 0
        fleet = Fleet.load(runs, **options)
        if step is None and not is_set(path, sumo_options, "step-length"):
            step = min(driver.policy.dt for driver in fleet.drivers.values())
        command = command_line(path, sumo_options, step=step, seed=seed, gui=gui)
        if not is_set(path, sumo_options, "error-log"):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-"))
            command += ["--error-log", str(Path(folder, "warnings.txt"))]
        with started(path, command, gui) as connection:
            log = Path(connection.simulation.getOption("error-log"))
            rows = VehicleRows.opened(stack, output, fleet) if output is not None else None
            observer = None
            if report_to is not None:
                observer = Observer()
            try:
                driving = _Run(connection, fleet, path, rows, make_actor(), _name(scenario))
                driving.observer = observer
                run = driving.go(end)
            except OSError as error:
                raise OutputError(
                    f"{output} cannot be written ({error.strerror or error}); name another --output"
                ) from error
        run = replace(run, left_out=left_out(log))
        _check_on_the_road(run, path)
        has_contact = any(collision.contact for collision in run.collisions)
        if not has_contact and observer is None:
            return run
        plain = Observer()
        command = command_line(path, sumo_options, step=step, seed=seed)
        with started(path, command, gui=False) as connection:
            of_sumo = _collisions_of_sumo(connection, fleet, run.steps, make_actor(), plain)
        if observer is not None and report_to is not None:
            both = ScenarioReport(observer.observations(), plain.observations())
            write_report(both, report_to)
        if not has_contact:
            return run
        return replace(run, collisions_of_sumo=of_sumo)


def _check_on_the_road(run: ScenarioRun, scenario: Path) -> None:
    """Checks that each driven vType had a vehicle."""
    for name, tally in run.tallies.items():
        if tally.vehicles:
            continue
        reason = ""
        if run.left_out:
            number, first = len(run.left_out), run.left_out[0]
            reason = f". SUMO left out {number} of the scenario's vehicles and flows: {first}"
        raise SumoError(
            f"no vehicle of vType '{name}' was ever on the road in {scenario}"
            f" ({run.steps * run.dt:g} s); give it a flow, or a later --end{reason}"
        )


def _collisions_of_sumo(
    sumo: Any, fleet: Fleet, steps: int, actor: Actor | None, observer: Observer
) -> CollisionCounts:
    """Returns how many collisions with contact a scenario has without drivers of cfx.

    Args:
        sumo: that has just started the scenario.
        fleet: whose vTypes count.
        steps: of the simulation.
        actor: acts on the simulation besides.
        observer: looks at the vehicles.
    """
    behind = crossing = 0
    before: set[tuple[str, str]] = set()
    with Task("The same without cfx's drivers", steps) as task:
        for _ in range(steps):
            if actor is not None:
                actor(sumo)
            sumo.simulationStep()
            observer.look(sumo)
            touching = set()
            for reported in sumo.simulation.getCollisions():
                is_driven = fleet.has_type(reported.colliderType)
                is_driven |= fleet.has_type(reported.victimType)
                if not is_driven:
                    continue
                is_crossing = _is_crossing(reported)
                gap = None if is_crossing else _gap_on_lane(sumo, reported)
                if gap is not None and gap > 0.0:
                    continue  # below minGap
                pair = reported.collider, reported.victim
                touching.add(pair)
                if pair in before:
                    continue  # one that lasts for steps counts once
                if is_crossing:
                    crossing += 1
                else:
                    behind += 1
            before = touching
            task.advance()
    return CollisionCounts(behind, crossing)


def _gap_on_lane(sumo: Any, reported: Any) -> float | None:
    """Returns the gap of a collision by the places of both on the lane, m; None: not known."""
    vehicle, victim = sumo.vehicle, reported.victim
    if victim not in vehicle.getIDList() or vehicle.getLaneID(victim) != reported.lane:
        return None
    rear = vehicle.getLanePosition(victim) - vehicle.getLength(victim)
    return float(rear - reported.pos)


def _is_crossing(reported: Any) -> bool:
    """Says whether a collision that SUMO reports is one of crossing paths."""
    return "junction" in reported.type


def _name(scenario: Path | str) -> str:
    """Returns how messages call a scenario."""
    return Path(scenario).name


def _prepared(
    scenario: Path | str, end: float | None, stack: ExitStack
) -> tuple[Path, Callable[[], Actor | None]]:
    """Returns SUMO's configuration, and what makes who acts on the simulation besides drivers."""
    shipped = SCENARIOS.get(str(scenario))
    path = Path(scenario)
    if shipped is not None and not path.exists():
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-")))
        return shipped.write(folder, end), shipped.make_actor or _nobody
    if not path.is_file():
        raise DataError(
            f"{path} is not there; name SUMO's configuration of the scenario (.sumocfg), or a"
            f" scenario that comes with cfx: {', '.join((*SCENARIOS, 'stress'))}"
        )
    return path, _nobody


def _nobody() -> None:
    """Makes nobody who acts on a simulation besides its drivers."""


class _Motions(NamedTuple):
    """What vehicles of a driver do, `(D,)` each; SI units.

    Attributes:
        names: of the vehicles.
        speed, acceleration: theirs.
        behind: how many the model drives behind a leader.
        time_gaps: of those that are faster than walking, s.
    """

    names: list[str]
    speed: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    behind: int
    time_gaps: NDArray[np.float64]

    @classmethod
    def of_view(cls, names: list[str], view: View) -> _Motions:
        """Returns what a driver has seen of all of its vehicles."""
        speed, behind = view.seen.speed.numpy(), len(view.following)
        gap = view.seen.gap.numpy()[:behind]
        moves = speed[:behind] > WALKING_MPS
        time_gaps = gap[moves] / speed[:behind][moves]
        return cls(names, speed, view.seen.acceleration.numpy(), behind, time_gaps)


class _Run:
    """One run of a scenario."""

    def __init__(
        self,
        sumo: Any,
        fleet: Fleet,
        scenario: Path,
        rows: VehicleRows | None,
        actor: Actor | None = None,
        title: str = "",
    ) -> None:
        self._sumo = sumo
        self._actor = actor
        self._name = title or scenario.name
        self._fleet = fleet
        self._scenario = scenario
        self._rows = rows
        self._tallies = {name: Tally() for name in fleet.drivers}
        self._type_of: dict[str, str] = {}
        self._lanes: dict[str, str] = {}
        self._lanes_next = -math.inf
        self._counted: Mapping[str, str] | None = None
        self._names: dict[str, list[str]] = {}
        self._braking: set[str] = set()
        self._collisions: list[Collision] = []
        self._touching: dict[tuple[str, str], Collision] = {}
        self._decel: dict[str, float] = {}
        self._least_decel: dict[str, float] = {}
        self._steps = 0
        self._others = 0
        self._most = 0
        self.observer: Observer | None = None
        self._check_types()
        self._name_members()

    def _check_types(self) -> None:
        """Checks that all vTypes are in the scenario."""
        vtypes = self._sumo.vehicletype.getIDList()
        for name in self._fleet.drivers:
            if name not in vtypes:
                of_scenario = []
                for vtype in vtypes:
                    if not vtype.startswith("DEFAULT_"):  # SUMO's own
                        of_scenario.append(vtype)
                raise SumoError(
                    f"{self._scenario} has no vType '{name}'.{nearest(name, of_scenario)} It has:"
                    f" {', '.join(of_scenario) or 'none of its own'}. (A vType must stand ahead of"
                    " the first vehicle.)"
                )

    def _name_members(self) -> None:
        """Lets the driver of a vTypeDistribution drive the vTypes that are its members."""
        get_option = self._sumo.simulation.getOption
        sumo_files = []
        for option in ("additional-files", "route-files"):
            for name in get_option(option).split(","):
                if name.strip():
                    sumo_files.append(Path(name.strip()))
        for name, members in members_of(self._fleet.drivers, sumo_files).items():
            for member in members:
                if member in self._fleet.drivers:
                    raise SumoError(
                        f"{self._scenario}: vType '{member}' is a member of the vTypeDistribution"
                        f" '{name}', and --drivers names both; name one of them"
                    )
            self._fleet.add_members(name, members)

    def go(self, end: float | None) -> ScenarioRun:
        """Runs the scenario to its end."""
        simulation = self._sumo.simulation
        dt = simulation.getDeltaT()
        last = self._last(end)
        total = 0
        if last < math.inf:
            total = max(0, round((last - simulation.getTime()) / dt))
        began = time.perf_counter()
        with Task(f"Driving {self._name}", total) as task:
            while simulation.getMinExpectedNumber() > 0 and simulation.getTime() < last - 1e-9:
                if self._actor is not None:
                    self._actor(self._sumo)
                self._sumo.simulationStep()
                self._note_collisions(dt)  # ahead of the drivers, who forget whoever has gone
                self._fleet.step(self._sumo)
                self._after_step(dt)
                task.advance()
        seconds = time.perf_counter() - began
        for collision in self._collisions:
            if collision.crossing:
                self._tallies[collision.kind].crossings += 1
            elif collision.contact:
                self._tallies[collision.kind].collisions += 1
            else:
                self._tallies[collision.kind].below_min_gap += 1
        limited, changed, outside, recorded, expected, fleets = {}, {}, {}, {}, {}, {}
        for name, driver in self._fleet.drivers.items():
            limited[name] = driver.counts.limited / max(1, driver.counts.steps)
            changed[name] = driver.counts.changed / max(1, driver.counts.told)
            outside[name] = driver.outside_in_words()
            trained_on = driver.policy.trained_on
            recorded[name] = trained_on.quantiles
            error = trained_on.expected_error
            expected[name] = "" if error is None else error.of_unseen_in_words()
            fleets[name] = driver.fleet_in_words()
        return ScenarioRun(
            self._tallies,
            self._steps,
            dt,
            seconds,
            self._others,
            self._most,
            limited,
            changed,
            outside,
            recorded,
            expected,
            self._collisions,
            fleets=fleets,
        )

    def _last(self, end: float | None) -> float:
        """Returns the simulated time at which the run ends at the latest, s."""
        last = math.inf
        if end is not None:
            last = end
        end_of_scenario = self._sumo.simulation.getEndTime()
        if end_of_scenario >= 0:  # -1: the scenario names none
            last = min(last, end_of_scenario)
        return last

    def _after_step(self, dt: float) -> None:
        """Notes what the last step did, and writes it down."""
        self._steps += 1
        vehicles = self._fleet.vehicles
        if vehicles is not self._counted:
            self._counted, self._names = vehicles, self._by_kind(vehicles)
            self._type_of |= vehicles
            for kind, names in self._names.items():
                self._tallies[kind].vehicles.update(names)
                self._least_decel[kind] = min(self._own_decel(name) for name in names)
        for kind, names in self._names.items():
            self._count(kind, names, dt)
        self._count_lanes(vehicles)
        self._count_teleports()
        if self.observer is not None:
            self.observer.look(self._sumo)
        if self._rows is not None:
            self._rows.write(self._sumo, self._fleet)
        self._others = max(self._others, self._sumo.vehicle.getIDCount() - len(vehicles))
        self._most = max(self._most, len(vehicles))

    def _by_kind(self, vehicles: Mapping[str, str]) -> dict[str, list[str]]:
        """Returns the vehicles of each vType that has some."""
        names: dict[str, list[str]] = {}
        for name, kind in vehicles.items():
            names.setdefault(kind, []).append(name)
        return names

    def _count(self, kind: str, names: list[str], dt: float) -> None:
        """Notes what the last step did to the vehicles of a vType."""
        tally, motions = self._tallies[kind], self._motions(self._fleet.drivers[kind], names)
        speed, acceleration = motions.speed, motions.acceleration
        tally.steps += len(names)
        tally.behind += motions.behind
        tally.metres += float(speed.sum()) * dt
        tally.hardest_braking = max(tally.hardest_braking, -float(acceleration.min()))
        tally.speeds.add(speed)
        tally.accelerations.add(acceleration)
        tally.braking.add((-acceleration).clip(min=0.0))
        tally.time_gaps.add(motions.time_gaps)
        brakes = set()
        # Whoever brakes no harder than the least `decel` of all need not be looked at.
        least = self._least_decel[kind]
        for number in (acceleration < -least - 1e-6).nonzero()[0].tolist():
            name = motions.names[number]
            if acceleration[number] < -self._own_decel(name) - 1e-6:
                brakes.add(name)
        tally.hard_brakings += len(brakes - self._braking)
        if self._braking:
            self._braking -= set(names)
        self._braking |= brakes

    def _motions(self, driver: Driver, names: list[str]) -> _Motions:
        """Returns what vehicles of a driver do.

        The driver has just looked at them, unless it has taken no step of its model. SUMO is asked
        again only then, or where vehicles of other vTypes have the same driver.
        """
        view = driver.looked_at()
        if view is not None and len(view.names) == len(names):
            looked = view.names
            if view.arrangement.requested == names or set(looked) == set(names):
                return _Motions.of_view(looked, view)
        vehicle = self._sumo.vehicle
        motions = []
        for name in names:
            motions.append((vehicle.getSpeed(name), vehicle.getAcceleration(name)))
        speed, acceleration = np.array(motions, dtype=np.float64).T
        behind = sum(map(driver.follows, names))
        return _Motions(names, speed, acceleration, behind, driver.time_gaps(names).numpy())

    def _count_lanes(self, vehicles: Mapping[str, str]) -> None:
        """Counts changes of lane on the same edge; they are looked for now and then."""
        now = self._sumo.simulation.getTime()
        if now < self._lanes_next - 1e-6:
            return
        self._lanes_next = now + _LANES_EVERY_S
        names = list(vehicles)
        lanes = dict(zip(names, lanes_of(self._sumo, names), strict=True))
        for name, lane in lanes.items():
            last_lane = self._lanes.get(name, lane)
            if lane == last_lane:
                continue
            edge, _, index = lane.rpartition("_")  # SUMO calls lanes EDGE_INDEX
            last_edge, _, last_index = last_lane.rpartition("_")
            if edge and edge == last_edge:
                self._tallies[vehicles[name]].lane_changes += abs(int(index) - int(last_index))
        self._lanes = lanes

    def _own_decel(self, name: str) -> float:
        """Returns the `decel` of a vehicle's vType, m/s2, whatever drivers make of it meanwhile."""
        if name not in self._decel:
            kind = self._sumo.vehicle.getTypeID(name).partition("@")[0]
            self._decel[name] = float(self._sumo.vehicletype.getDecel(kind))
        return self._decel[name]

    def _note_collisions(self, dt: float) -> None:
        """Notes the collisions that SUMO reports after a step; one that goes on is one."""
        now = self._sumo.simulation.getTime()
        touching = {}
        for reported in self._sumo.simulation.getCollisions():
            kind = self._type_of.get(reported.collider) or self._type_of.get(reported.victim)
            if kind is None:
                continue
            key = reported.collider, reported.victim
            collision, gap_before = self._touching.get(key), self._gap_before(*key)
            if collision is None:
                gap = self._gap(reported, gap_before, dt)
                collision = Collision(
                    now,
                    kind,
                    *key,
                    reported.lane,
                    reported.pos,
                    gap,
                    crossing=_is_crossing(reported),
                    inserted=reported.collider in self._sumo.simulation.getDepartedIDList(),
                )
                self._collisions.append(collision)
            elif collision.gap is not None and gap_before is not None:
                # SUMO goes on to report the speeds of the first step.
                collision.gap = min(collision.gap, gap_before)
            touching[key] = collision
        self._touching = touching

    def _gap_before(self, collider: str, victim: str) -> float | None:
        """Returns the gap of a driven vehicle one step ago; None behind another vehicle."""
        if collider not in self._fleet.vehicles:
            return None
        return self._fleet.driver(collider).gap_to(collider, victim)

    def _gap(self, reported: Any, gap_before: float | None, dt: float) -> float | None:
        """Returns the gap as a collision begins, bumper to bumper, m.

        SUMO may have taken the vehicles off the road by now. So it is the gap of the step before,
        and what their speeds have made of it; for a vehicle that has just changed lanes, or that no
        policy drives, the places of both on the lane.
        """
        if reported.type != "collision":
            return None  # their paths cross, or they meet head-on
        if gap_before is not None:
            return float(gap_before + (reported.victimSpeed - reported.colliderSpeed) * dt)
        return _gap_on_lane(self._sumo, reported)

    def _count_teleports(self) -> None:
        for name in self._sumo.simulation.getStartingTeleportIDList():
            if name in self._type_of:
                self._tallies[self._type_of[name]].teleports += 1
