"""`cfx drive`: runs a user's SUMO scenario with live drivers for some of its vTypes.

SUMO runs in this process (libsumo), so nothing here may load pyarrow, with which it does not get
on.
"""

from __future__ import annotations

import csv
import math
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO, Unpack
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cfx.errors import ConfigError, DataError, OutputError, SumoError, nearest
from cfx.plugin import Task, files
from cfx_sumo.drive.distributions import members_of
from cfx_sumo.drive.left_out import left_out
from cfx_sumo.drive.scenario_report import Observer, ScenarioReport, write_report
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.installed import require_sumo
from cfx_sumo.live.driver import Driver, DriverOptions
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.live.histories import WALKING_MPS
from cfx_sumo.live.surroundings import View, lanes_of

if TYPE_CHECKING:
    from rich.table import Table

Actor = Callable[[Any], None]
"""Acts on a simulation before each of its steps."""

_QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles by which live traffic is compared with the recording."""


_DECIMALS = 6
"""Of the output's numbers: micrometres, however far a vehicle is from the origin."""

_LANES_EVERY_S = 0.5
"""s: lanes are looked at no more often, as SUMO has to be asked for each vehicle."""

_LISTED = 10
"""Collisions, and vehicles left out, that the report lists."""


class Histogram:
    """Counts values in bins of equal width; those beyond the ends count in the last bins.

    Args:
        low, high: ends.
        width: of a bin, which is also how exactly quantiles are known.
    """

    def __init__(self, low: float, high: float, width: float) -> None:
        self.low, self.width = low, width
        self.counts = np.zeros(round((high - low) / width), dtype=np.int64)

    def add(self, values: Sequence[float] | np.ndarray) -> None:
        """Counts values; those that are not finite are left out."""
        array = np.asarray(values, dtype=np.float64)
        array = array[np.isfinite(array)]
        places = ((array - self.low) / self.width).astype(np.int64)
        last = len(self.counts) - 1
        self.counts += np.bincount(places.clip(0, last), minlength=last + 1)

    def quantile(self, share: float) -> float:
        """Returns the value below which this share lies, to half a bin; NaN if there is none."""
        total = int(self.counts.sum())
        if total == 0:
            return float("nan")
        place = int(np.searchsorted(self.counts.cumsum(), share * total))
        return self.low + (place + 0.5) * self.width


@dataclass
class Tally:
    """What the vehicles of one vType did.

    Attributes:
        vehicles: ids of all that were on the road.
        steps: vehicle steps.
        behind: those of them behind a leader; in the others no vehicle was ahead.
        metres: the distance that all covered together.
        lane_changes: on the same edge.
        hard_brakings: times that a vehicle began to brake harder than its vType's `decel`.
        hardest_braking: the largest deceleration of any, m/s2.
        braking: decelerations of all steps, m/s2; 0 where a vehicle did not brake.
        speeds: of all steps, m/s.
        accelerations: of all steps, m/s2.
        time_gaps: of the steps behind a leader faster than walking, s.
        collisions: of those that SUMO reported, the ones with contact (`Collision.contact`) of a
            vehicle and the one ahead of it.
        below_min_gap: those in which the gap was below minGap, and nobody was touched.
        crossings: those of vehicles whose paths cross at a junction.
        teleports: vehicles that SUMO reported; a vehicle may teleport more than once.
    """

    vehicles: set[str] = field(default_factory=set)
    steps: int = 0
    behind: int = 0
    metres: float = 0.0
    lane_changes: int = 0
    hard_brakings: int = 0
    hardest_braking: float = 0.0
    braking: Histogram = field(default_factory=lambda: Histogram(0.0, 20.0, 0.02))
    speeds: Histogram = field(default_factory=lambda: Histogram(0.0, 70.0, 0.1))
    accelerations: Histogram = field(default_factory=lambda: Histogram(-15.0, 8.0, 0.02))
    time_gaps: Histogram = field(default_factory=lambda: Histogram(0.0, 30.0, 0.05))
    collisions: int = 0
    below_min_gap: int = 0
    crossings: int = 0
    teleports: int = 0


@dataclass
class Collision:
    """What SUMO reports as a collision of two vehicles, however many steps it lasts.

    SUMO reports a gap below the follower's `minGap` as well (`collision.mingap-factor`).

    Attributes:
        time: s, of the first step.
        kind: the driven vType of the collider; of the victim, where no policy drives the collider.
        collider, victim: their ids.
        lane: of the collider.
        position: of the collider's front on it, m.
        gap: the smallest, from bumper to bumper, m; None: not known, as where paths cross.
        crossing: whether their paths cross at a junction; otherwise one is behind the other.
        inserted: whether SUMO has just put the collider there, as it does on an edge that is
            shorter than a vehicle.
    """

    time: float
    kind: str
    collider: str
    victim: str
    lane: str
    position: float
    gap: float | None
    crossing: bool = False
    inserted: bool = False

    @property
    def contact(self) -> bool:
        """Whether they touched; also where the gap is not known."""
        return self.gap is None or self.gap <= 0.0

    def __str__(self) -> str:
        """Returns who, where and when on one line."""
        if self.crossing:
            return (
                f"{self.time:.2f} s: {self.collider} and {self.victim}, whose paths cross, on"
                f" {self.lane} at {self.position:.1f} m"
            )
        what = "contact"
        if not self.contact:
            what = "below minGap"
        gap = "gap not known"
        if self.gap is not None:
            gap = f"gap {self.gap:.2f} m"
        where = ", where SUMO has just inserted it" if self.inserted else ""
        return (
            f"{self.time:.2f} s: {self.collider} behind {self.victim} on {self.lane} at"
            f" {self.position:.1f} m{where}: {what}, {gap}"
        )


class CollisionCounts(NamedTuple):
    """How many collisions there were with contact.

    Attributes:
        behind: of a vehicle and the one ahead of it.
        crossing: of vehicles whose paths cross at a junction.
    """

    behind: int
    crossing: int

    def __str__(self) -> str:
        """Returns both in words."""
        return f"{self.behind} with the vehicle ahead, {self.crossing} where paths cross"


@dataclass(frozen=True)
class ScenarioRun:
    """What `run_scenario` reports.

    Attributes:
        tallies: for each vType that was driven.
        steps: of the simulation.
        dt: its time step, s.
        seconds: how long it took.
        others: most vehicles of other types at one time.
        most: most vehicles of the driven types at one time.
        limited: for each vType, the share of the model's steps behind a leader that are at a limit
            of acceleration.
        changed: for each vType, the share of the speeds that SUMO's checks changed.
        outside: for each vType, how much was driven outside what its policy has learned, in words;
            "" where nothing was.
        recorded: for each vType, quantiles of the recording that its policy learned from, by
            signal (`Agent.recorded`).
        expected: for each vType, what error of speed to expect of its policy, in words; "" where
            that is not known.
        collisions: that SUMO reported of driven vehicles, in their order.
        collisions_of_sumo: how many SUMO has in the same scenario where its own models drive all;
            None where there was nothing to compare with them.
        left_out: what SUMO says of the vehicles and flows of the scenario that it left out.
        fleets: for each vType, in words, who drives its vehicles.
    """

    tallies: Mapping[str, Tally]
    steps: int
    dt: float
    seconds: float
    others: int
    most: int
    limited: Mapping[str, float] = field(default_factory=dict)
    changed: Mapping[str, float] = field(default_factory=dict)
    outside: Mapping[str, str] = field(default_factory=dict)
    recorded: Mapping[str, Mapping[str, Sequence[float]]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    collisions: Sequence[Collision] = ()
    collisions_of_sumo: CollisionCounts | None = None
    left_out: Sequence[str] = ()
    fleets: Mapping[str, str] = field(default_factory=dict)

    @property
    def real_time(self) -> float:
        """Simulated seconds per second."""
        if self.seconds <= 0:
            return float("inf")
        return self.steps * self.dt / self.seconds


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
        if step is None and not _is_set(path, sumo_options, "step-length"):
            step = min(driver.policy.dt for driver in fleet.drivers.values())
        command = command_line(path, sumo_options, step=step, seed=seed, gui=gui)
        if not _is_set(path, sumo_options, "error-log"):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-"))
            command += ["--error-log", str(Path(folder, "warnings.txt"))]
        with started(path, command, gui) as connection:
            log = Path(connection.simulation.getOption("error-log"))
            rows = _Rows.opened(stack, output, fleet) if output is not None else None
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


@contextmanager
def started(scenario: Path, command: Sequence[str], gui: bool) -> Iterator[Any]:
    """Starts SUMO for a block; gives its connection.

    Args:
        scenario: for messages.
        command: SUMO's command line.
        gui: whether it is that of SUMO's window.

    Raises:
        SumoError: a simulation is open in this process, which is left as it is; SUMO refuses the
            scenario, or stops in the block.
    """
    try:
        sumo = _window(command) if gui else _in_process(command)
    except Exception as error:
        if not _is_sumos(error):
            raise
        raise SumoError(f"SUMO refuses {scenario}: {_reason(error)}") from error
    try:
        yield sumo
    except Exception as error:
        if not _is_sumos(error):
            raise
        raise SumoError(f"SUMO stopped {scenario}: {_reason(error)}") from error
    finally:
        _close(sumo)


_QUIET = "LIBSUMO_AS_TRACI"

_CHECK_JUNCTIONS = "--collision.check-junctions"


def _in_process(command: Sequence[str]) -> Any:
    """Starts SUMO in this process; returns libsumo, which has room for one simulation."""
    before = os.environ.get(_QUIET)
    # No word about pyarrow, which is not loaded here.
    os.environ.setdefault(_QUIET, "quiet")
    try:
        import libsumo
    finally:
        if before is None:
            del os.environ[_QUIET]
    if libsumo.isLoaded():
        raise SumoError(
            "a simulation is open in this process, and libsumo has room for one; close it first"
            " (libsumo.close()), or run this in a process of its own"
        )
    try:
        libsumo.start(list(command))
    except Exception:
        _close(libsumo)  # what it refuses stays loaded otherwise
        raise
    return libsumo


def _window(command: Sequence[str]) -> Any:
    """Starts SUMO's window; returns a connection beside those that the caller may have."""
    import traci  # type: ignore[import-untyped]  # SUMO brings no types

    label = f"cfx-{secrets.token_hex(4)}"
    traci.start(list(command), label=label, doSwitch=False)
    return traci.getConnection(label)


def _close(sumo: Any) -> None:
    try:
        sumo.close()
    except Exception as error:  # SUMO has gone already; why was said
        if not _is_sumos(error):
            raise


def _is_sumos(error: Exception) -> bool:
    """Says whether an error is SUMO's word; libsumo's and traci's are classes of the same names."""
    return type(error).__name__ in {"TraCIException", "FatalTraCIError"}


def _gui_program() -> str:
    try:
        import sumo  # of the wheel eclipse-sumo, which the extra leaves out for its size

        program = shutil.which("sumo-gui", path=str(Path(sumo.__file__).parent / "bin"))
    except ImportError:
        program = shutil.which("sumo-gui")
    if program is None:
        raise SumoError("--gui needs SUMO's window, sumo-gui: pip install eclipse-sumo")
    return program


def _is_set(scenario: Path, options: Sequence[str], name: str) -> bool:
    """Says whether SUMO's configuration or the user's own options set one of SUMO's options."""
    if any(option.partition("=")[0] == f"--{name}" for option in options):
        return True
    try:
        # S314: it is the user's own file, which SUMO reads next.
        return next(ElementTree.parse(scenario).iter(name), None) is not None  # noqa: S314
    except ElementTree.ParseError:
        return True  # SUMO says what is wrong with it


def command_line(
    scenario: Path,
    options: Sequence[str] = (),
    *,
    step: float | None = None,
    seed: int | None = None,
    gui: bool = False,
) -> list[str]:
    """Returns SUMO's command line; the user's own options come last and win.

    Args:
        scenario: SUMO's configuration.
        options: the user's own.
        step: of the simulation, s; None: the configuration's.
        seed: SUMO's; None: the configuration's.
        gui: whether SUMO's window is shown.
    """
    command = ["sumo", "-c", str(scenario)]
    if gui:
        command[0] = _gui_program()
        command += ["--start", "--quit-on-end", "--delay", "100"]
    # SUMO does not look for collisions at junctions unless it is told to.
    switches = ("--no-step-log", "--duration-log.disable", "--no-warnings", _CHECK_JUNCTIONS)
    set_by_user = {option.partition("=")[0] for option in options}
    for name in switches:
        if name not in set_by_user:
            command += [name, "true"]
    if step is not None:
        command += ["--step-length", f"{step:g}"]
    if seed is not None:
        command += ["--seed", str(seed)]
    return command + list(options)


def _reason(error: Exception) -> str:
    """Returns SUMO's words on one line; some of them it prints on stderr alone."""
    message = " ".join(str(error).split()).rstrip(".")
    if message in {"", "Process Error", "Connection closed by SUMO"}:
        return "its own message stands above"
    return message


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
        rows: _Rows | None,
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


class _Rows:
    """The output: a row for each vehicle of the fleet and step, SI units."""

    _COLUMNS = (
        "time_s",
        "vehicle",
        "type",
        "edge",
        "lane",
        "position_m",
        "x_m",
        "y_m",
        "speed_mps",
        "acceleration_mps2",
    )

    def __init__(self, file: TextIO, parameters: Sequence[str]) -> None:
        self._writer = csv.writer(file)
        self._parameters = list(parameters)
        self._writer.writerow([*self._COLUMNS, *(f"parameter_{name}" for name in parameters)])

    @classmethod
    def opened(cls, stack: ExitStack, path: Path, fleet: Fleet) -> _Rows:
        """Opens the file, which takes its name when the run has ended well."""
        if path.is_dir():
            raise OutputError(f"{path} is a folder; name a file in --output")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = stack.enter_context(files.atomic_write(path))
            file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({error.strerror}); name another --output"
            ) from error
        names: dict[str, None] = {}
        for driver in fleet.drivers.values():
            names |= dict.fromkeys(driver.policy.space.names)
        return cls(file, list(names))

    def write(self, sumo: Any, fleet: Fleet) -> None:
        """Writes where the fleet's vehicles are, and the parameters with which they drive on."""
        for name, kind in fleet.vehicles.items():
            self._writer.writerow(self._row(sumo, name, kind, fleet.drivers[kind].parameters(name)))

    def _row(self, sumo: Any, name: str, kind: str, parameters: Mapping[str, float]) -> list[str]:
        vehicle = sumo.vehicle
        lane = [vehicle.getRoadID(name), str(vehicle.getLaneIndex(name))]
        x, y = vehicle.getPosition(name)
        speed, acceleration = vehicle.getSpeed(name), vehicle.getAcceleration(name)
        row = [f"{sumo.simulation.getTime():.10g}", name, kind, *lane]
        for value in (vehicle.getLanePosition(name), x, y, speed, acceleration):
            row.append(repr(round(value, _DECIMALS)))
        for parameter in self._parameters:
            value = parameters.get(parameter)
            row.append("" if value is None else repr(round(value, _DECIMALS)))
        return row


def parse_drivers(arguments: Sequence[str]) -> dict[str, str]:
    """Reads `TYPE=RUN` arguments.

    Raises:
        ConfigError: one is not of this form, or names a vType twice.
    """
    runs: dict[str, str] = {}
    for argument in arguments:
        name, equals, run = argument.partition("=")
        if not (name and equals and run):
            raise ConfigError(
                f"--drivers {argument}: write TYPE=RUN, a vType of the scenario and a job's output"
                " folder or a ready-made policy, such as car=cfx://idm"
            )
        if name in runs:
            raise ConfigError(f"--drivers: vType '{name}' stands twice")
        runs[name] = run
    return runs


def report(run: ScenarioRun) -> None:
    """Prints what happened: tables, and one line about speed."""
    from cfx.plugin import console

    console.print_table(_what_happened(run))
    console.print_table(_braking(run))
    console.print_table(_beside_the_recording(run))
    for collision in run.collisions[:_LISTED]:
        print(collision)
    if len(run.collisions) > _LISTED:
        print(f"... and {len(run.collisions) - _LISTED} more collisions")
    if any(not collision.contact for collision in run.collisions):
        print(
            "SUMO takes a gap below minGap for a collision, and teleports the vehicle unless the"
            " scenario says otherwise; -- --collision.mingap-factor 0 leaves contact alone"
        )
    for sentence in run.left_out[:_LISTED]:
        print(f"left out by SUMO: {sentence}")
    if len(run.left_out) > _LISTED:
        print(f"... and {len(run.left_out) - _LISTED} more vehicles and flows left out")
    if run.collisions_of_sumo is not None:
        behind = sum(tally.collisions for tally in run.tallies.values())
        crossings = sum(tally.crossings for tally in run.tallies.values())
        print(
            f"Collisions: {CollisionCounts(behind, crossings)}; where SUMO's own models drive all"
            f" of them in the same scenario: {run.collisions_of_sumo}"
        )
    for name, words in run.fleets.items():
        print(f"{name}: {words}")
    for name, words in run.expected.items():
        if words:
            print(f"{name}: {words}")
    for name, words in run.outside.items():
        if words:
            print(f"{name}: {words}; there it fades towards its base parameters")
    print(
        f"{run.steps} steps of {run.dt:g} s in {run.seconds:.1f} s, {run.real_time:.1f} times real"
        f" time; at most {run.most} of these vehicles at once, {run.others} others"
    )


def _what_happened(run: ScenarioRun) -> Table:
    table = _table(
        "vType",
        "vehicles",
        "behind a leader",
        "mean speed [m/s]",
        "lane changes",
        "collisions",
        "below minGap",
        "crossing paths",
        "teleports",
    )
    for name, tally in run.tallies.items():
        table.add_row(
            name,
            str(len(tally.vehicles)),
            f"{tally.behind / tally.steps:.0%}",
            f"{tally.metres / (tally.steps * run.dt):.2f}",
            str(tally.lane_changes),
            str(tally.collisions),
            str(tally.below_min_gap),
            str(tally.crossings),
            str(tally.teleports),
        )
    return table


def _braking(run: ScenarioRun) -> Table:
    """Returns how hard vehicles braked, m/s2."""
    table = _table(
        "braking [m/s2]",
        "95 % of steps below",
        "99.9 % below",
        "hardest",
        "times above decel",
        "steps at limits",
        "changed by SUMO",
    )
    for name, tally in run.tallies.items():
        table.add_row(
            name,
            f"{tally.braking.quantile(0.95):.2f}",
            f"{tally.braking.quantile(0.999):.2f}",
            f"{tally.hardest_braking:.2f}",
            str(tally.hard_brakings),
            f"{run.limited.get(name, 0.0):.1%}",
            f"{run.changed.get(name, 0.0):.1%}",
        )
    return table


def _beside_the_recording(run: ScenarioRun) -> Table:
    """Returns quantiles of the live vehicles beside those of what their policy learned from."""
    table = _table("5 %, median, 95 %", "speed [m/s]", "acceleration [m/s2]", "time gap [s]")
    for name, tally in run.tallies.items():
        live = []
        for histogram in (tally.speeds, tally.accelerations, tally.time_gaps):
            live.append(_listed([histogram.quantile(share) for share in _QUANTILES]))
        table.add_row(name, *live)
        recorded = run.recorded.get(name) or {}
        if recorded:
            signals = ("speed", "acceleration", "time_gap")
            table.add_row("its recording", *(_listed(recorded[signal]) for signal in signals))
    return table


def _table(*columns: str) -> Table:
    from cfx.plugin import console

    table = console.blank_table(*columns)
    for column in table.columns[1:]:
        column.justify = "right"
    return table


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
