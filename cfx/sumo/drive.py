"""`cfx drive`: runs somebody's SUMO scenario with live drivers for some of its vTypes, and says what happened.

SUMO runs in this process (libsumo), so nothing here may load pyarrow, with which it does not get on.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from cfx.errors import ConfigError, DataError, OutputError, SumoError, nearest
from cfx.files import atomic_write
from cfx.progress import Task
from cfx.simulators.sumo.installed import require_sumo
from cfx.sumo.fleet import Fleet


@dataclass
class Tally:
    """What the vehicles of one vType did.

    Attributes:
        vehicles: ids of all that were on the road.
        steps: vehicle steps.
        driven: those of them that the model drove; in the others nobody was ahead.
        metres: driven by all together.
        lane_changes: on the same edge.
        hard_brakings: times that a vehicle began to brake harder than its vType's `decel`.
        collisions, teleports: vehicles that SUMO reported; a vehicle may do so more than once.
    """

    vehicles: set[str] = field(default_factory=set)
    steps: int = 0
    driven: int = 0
    metres: float = 0.0
    lane_changes: int = 0
    hard_brakings: int = 0
    collisions: int = 0
    teleports: int = 0


@dataclass(frozen=True)
class Driven:
    """What `drive` reports.

    Attributes:
        tallies: for each vType that was driven.
        steps: of the simulation.
        dt: its time step, s.
        seconds: how long it took.
        others: most vehicles of other types at one time.
        most: most vehicles of the driven types at one time.
    """

    tallies: Mapping[str, Tally]
    steps: int
    dt: float
    seconds: float
    others: int
    most: int

    @property
    def real_time(self) -> float:
        """Simulated seconds per second."""
        return self.steps * self.dt / self.seconds if self.seconds > 0 else float("inf")


def drive(
    scenario: Path,
    runs: Mapping[str, str | Path],
    *,
    end: float | None = None,
    seed: int | None = None,
    output: Path | None = None,
    look_ahead: float = 200.0,
    speed_mode: int = 0,
    options: Sequence[str] = (),
) -> Driven:
    """Runs a scenario in libsumo until it is over.

    It is over when no vehicle is on the road or still to come, at the end that the scenario gives, or at `end`. A vehicle that
    arrives, teleports, collides or changes lanes ends nothing: it is counted, and goes on with what SUMO makes of it (one that
    teleported begins anew).

    Args:
        scenario: SUMO's configuration (`.sumocfg`).
        runs: vType -> a job's output folder, or the id of its MLflow run.
        end: s of simulated time.
        seed: SUMO's; None for the scenario's.
        output: a CSV file with a row for each driven vehicle and step.
        look_ahead, speed_mode: as in `Driver`.
        options: more of SUMO's own options.

    Raises:
        SumoError: SUMO is missing, refuses the scenario or stops; a vType is not in it or never on the road; the steps differ.
        DataError: a run has no policy that drives unseen drivers, or the scenario is not there.
        OutputError: the output cannot be written.
    """
    require_sumo()
    if not scenario.is_file():
        raise DataError(
            f"{scenario} is not there; name SUMO's configuration of the scenario (.sumocfg)"
        )
    fleet = Fleet.load(runs, look_ahead=look_ahead, speed_mode=speed_mode)
    os.environ.setdefault(
        "LIBSUMO_AS_TRACI", "quiet"
    )  # no word about pyarrow, which is not loaded here
    import libsumo

    command = ["sumo", "-c", str(scenario)]
    for name in ("--no-step-log", "--duration-log.disable", "--no-warnings"):
        command += [name, "true"] * (name not in options)
    command += ["--seed", str(seed)] * (seed is not None) + list(options)
    try:
        libsumo.start(command)
    except libsumo.TraCIException as error:
        raise SumoError(f"SUMO refuses {scenario}: {_reason(error)}") from error
    try:
        with ExitStack() as stack:
            rows = _Rows.opened(stack, output, fleet) if output is not None else None
            return _Run(libsumo, fleet, scenario, rows).go(end)
    except libsumo.TraCIException as error:
        raise SumoError(f"SUMO stopped {scenario}: {_reason(error)}") from error
    except OSError as error:
        raise OutputError(
            f"{output} cannot be written ({error.strerror or error}); name another --output"
        ) from error
    finally:
        libsumo.close()


def _reason(error: Exception) -> str:
    """Returns SUMO's words on one line; some of them it prints on stderr alone."""
    said = " ".join(str(error).split()).rstrip(".")
    return "its own message stands above" if said in {"", "Process Error"} else said


class _Run:
    """One run of a scenario."""

    def __init__(self, sumo: Any, fleet: Fleet, scenario: Path, rows: _Rows | None) -> None:
        self._sumo, self._fleet, self._scenario, self._rows = sumo, fleet, scenario, rows
        self._tallies = {name: Tally() for name in fleet.drivers}
        self._type_of: dict[str, str] = {}
        self._lanes: dict[str, tuple[str, int]] = {}
        self._braking: set[str] = set()
        self._decel = {name: float(sumo.vehicletype.getDecel(name)) for name in self._checked()}

    def _checked(self) -> Sequence[str]:
        """Returns the vTypes, all of which are in the scenario."""
        known = self._sumo.vehicletype.getIDList()
        for name in self._fleet.drivers:
            if name not in known:
                own = [one for one in known if not one.startswith("DEFAULT_")]
                raise SumoError(
                    f"{self._scenario} has no vType '{name}'.{nearest(name, own)} It has: {', '.join(own) or 'none of its own'}."
                    " (A vTypeDistribution has members: name them. A vType must stand ahead of the first vehicle.)"
                )
        return list(self._fleet.drivers)

    def go(self, end: float | None) -> Driven:
        """Drives to the end."""
        simulation = self._sumo.simulation
        dt, start = simulation.getDeltaT(), simulation.getTime()
        given = simulation.getEndTime()
        last = min(
            [one for one in (end, given if given >= 0 else None) if one is not None], default=None
        )
        total = max(0, round((last - start) / dt)) if last is not None else 0
        steps = others = most = 0
        began = time.perf_counter()
        with Task(f"Driving {self._scenario.name}", total) as task:
            while simulation.getMinExpectedNumber() > 0 and (
                last is None or simulation.getTime() < last - 1e-9
            ):
                self._sumo.simulationStep()
                self._fleet.step(self._sumo)
                steps += 1
                self._type_of |= self._fleet.vehicles
                self._count()
                if self._rows is not None:
                    self._rows.write(self._sumo, self._fleet)
                own = len(self._fleet.vehicles)
                others, most = max(others, self._sumo.vehicle.getIDCount() - own), max(most, own)
                task.advance()
        seconds = time.perf_counter() - began
        never = [name for name, tally in self._tallies.items() if not tally.vehicles]
        if never:
            raise SumoError(
                f"no vehicle of vType '{never[0]}' was ever on the road in {self._scenario} ({steps * dt:g} s); give it a flow,"
                " or a later --end"
            )
        return Driven(self._tallies, steps, dt, seconds, others, most)

    def _count(self) -> None:
        """Notes what the last step did to the fleet's vehicles."""
        vehicle, dt = self._sumo.vehicle, self._sumo.simulation.getDeltaT()
        for name, kind in self._fleet.vehicles.items():
            tally = self._tallies[kind]
            tally.vehicles.add(name)
            tally.steps += 1
            tally.driven += self._fleet.drivers[kind].drives(name)
            tally.metres += vehicle.getSpeed(name) * dt
            lane = vehicle.getRoadID(name), vehicle.getLaneIndex(name)
            before = self._lanes.get(name, lane)
            tally.lane_changes += before[0] == lane[0] and before[1] != lane[1]
            self._lanes[name] = lane
            hard = vehicle.getAcceleration(name) < -self._decel[kind] - 1e-6
            tally.hard_brakings += hard and name not in self._braking
            (self._braking.add if hard else self._braking.discard)(name)
        for counted, names in (
            ("collisions", self._sumo.simulation.getCollidingVehiclesIDList()),
            ("teleports", self._sumo.simulation.getStartingTeleportIDList()),
        ):
            for name in names:
                if name in self._type_of:
                    tally = self._tallies[self._type_of[name]]
                    setattr(tally, counted, getattr(tally, counted) + 1)


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
            partial = stack.enter_context(atomic_write(path))
            file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({error.strerror}); name another --output"
            ) from error
        names = dict.fromkeys(
            name for driver in fleet.drivers.values() for name in driver.policy.space.names
        )
        return cls(file, list(names))

    def write(self, sumo: Any, fleet: Fleet) -> None:
        """Writes where everybody of the fleet is, and with which parameters he drives on."""
        now, vehicle = f"{sumo.simulation.getTime():.10g}", sumo.vehicle
        for name, kind in fleet.vehicles.items():
            x, y = vehicle.getPosition(name)
            chosen = fleet.drivers[kind].parameters(name)
            signals = (
                vehicle.getLanePosition(name),
                x,
                y,
                vehicle.getSpeed(name),
                vehicle.getAcceleration(name),
            )
            self._writer.writerow(
                [
                    *(now, name, kind, vehicle.getRoadID(name), vehicle.getLaneIndex(name)),
                    *(f"{value:.6g}" for value in signals),
                    *(f"{chosen[one]:.6g}" if one in chosen else "" for one in self._parameters),
                ]
            )


def parse_drivers(given: Sequence[str]) -> dict[str, str]:
    """Reads `TYPE=RUN` arguments.

    Raises:
        ConfigError: one is not of this form, or names a vType twice.
    """
    runs: dict[str, str] = {}
    for one in given:
        name, equals, run = one.partition("=")
        if not (name and equals and run):
            raise ConfigError(
                f"--drivers {one}: write TYPE=RUN, a vType of the scenario and a job's output folder"
            )
        if name in runs:
            raise ConfigError(f"--drivers: vType '{name}' stands twice")
        runs[name] = run
    return runs


def report(driven: Driven) -> None:
    """Prints what happened: one table, and one line about speed."""
    from cfx.console import blank_table, put

    columns = (
        "vType",
        "vehicles",
        "model drove",
        "mean speed [m/s]",
        "lane changes",
        "hard brakings",
        "collisions",
        "teleports",
    )
    table = blank_table(*columns)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, tally in driven.tallies.items():
        share, speed = tally.driven / tally.steps, tally.metres / (tally.steps * driven.dt)
        counts = (tally.lane_changes, tally.hard_brakings, tally.collisions, tally.teleports)
        table.add_row(
            name, str(len(tally.vehicles)), f"{share:.0%}", f"{speed:.2f}", *map(str, counts)
        )
    put(table)
    print(
        f"{driven.steps} steps of {driven.dt:g} s in {driven.seconds:.1f} s, {driven.real_time:.1f} times real time; at most"
        f" {driven.most} of these vehicles at once, {driven.others} others"
    )
