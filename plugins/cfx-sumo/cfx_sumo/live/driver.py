"""Live drivers: a trained policy drives vehicles of a user's SUMO simulation.

The simulation is reached through TraCI or libsumo.

W99's parameters cannot be changed in SUMO while a vehicle drives. So cfx computes each vehicle's
next speed with its own model, which is SUMO's model, and gives SUMO that speed: what SUMO then
drives is exact. All vehicles of a step are one batch, through one call of the policy and one call
of the model.

Shapes: D vehicles, n tuned parameters, L frames of a token.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import TypedDict, Unpack, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.errors import DataError, SumoError
from cfx.plugin import (
    ANY_DRIVER,
    Agent,
    DrivingModel,
    registry,
    require_no_further_signals,
    threads,
)
from cfx_sumo.live.assignments import Assignments
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.control import VehicleControl
from cfx_sumo.live.counts import DriveCounts
from cfx_sumo.live.histories import Histories, frame_of
from cfx_sumo.live.motion import ModelSteps
from cfx_sumo.live.orders import set_speeds
from cfx_sumo.live.policies import check_model, constant_policy, load_policy
from cfx_sumo.live.roster import Roster
from cfx_sumo.live.saved import DriverRecord, read_state, write_state
from cfx_sumo.live.surroundings import Connection, Seen, View, look
from cfx_sumo.live.vehicles import KnownVehicles
from cfx_sumo.live.windows import PolicyWindows
from cfx_sumo.live.zippers import EASY_MPS2, Turns, Zippers

_BOUNDS_BRAKING = 4
"""Bit of SUMO's speed mode with which a vehicle brakes no harder than its `decel`."""

_YIELDS = 8
"""Bit of the speed mode with which a vehicle regards who goes first at junctions."""

_Floats = NDArray[np.float64]
_Places = NDArray[np.int64]

Together = dict[tuple[int, int], dict[str, float]]
"""Speeds of vehicles, m/s, that drivers of one simulation expect within a step of it: by how many
steps their models take in it, and which of these it is."""

OBEYS_ALL = 31
"""Speed mode with all of SUMO's checks: lights, stops, yielding, its safe gap."""


class DriverOptions(TypedDict, total=False):
    """How vehicles are driven, whoever drives them.

    Attributes:
        look_ahead: m; a vehicle farther ahead (bumper to bumper) is no leader: then the policy's
            own model drives freely.
        speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven: 31 obeys
            lights, stops and junctions and keeps SUMO's safe gap; 0 does none of it.
        seed: of what a stochastic policy leaves to chance: what is drawn for a vehicle depends on
            it, the vehicle's id and the simulated time alone; None: nothing is drawn.
        average: every vehicle has the same driver, the average one; otherwise each draws, by the
            seed and its id, one of the recorded drivers whom the policy learned from, where it
            knows them (`TrainedOn.drivers`).
    """

    look_ahead: float
    speed_mode: int
    seed: int | None
    average: bool


@dataclass(frozen=True)
class LastDrive:
    """What the last call drove, if it drove all vehicles that it was given.

    Mostly the next call is one period later and for the same vehicles, behind the same leaders.
    Then nobody begins anew, and all were told a speed.

    Attributes:
        view: of the vehicles; None: there was no such call.
        rows: theirs, `(D,)` int64, in the view's order.
        time: s.
    """

    view: View | None = None
    rows: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64))
    time: float = math.nan

    def goes_on(self, names: list[str], now: float, clock: Clock) -> bool:
        """Says whether the same vehicles are driven one period later; a list of them is kept."""
        is_next = abs(now - self.time - clock.period) < 0.5 * clock.dt
        return self.view is not None and is_next and self.view.arrangement.requested is names

    def is_arranged(self, view: View) -> bool:
        """Says whether everybody is still behind the same leader."""
        return self.view is not None and self.view.arrangement is view.arrangement


class Driver:
    """Drives any number of vehicles with the policy of one job.

        driver = Driver.load("outputs/my-job")
        connection.simulationStep()
        driver.step(connection, vehicle_ids)

    Life cycle of a vehicle: it is driven from the first `step` that names it. Behind a leader the
    policy sees the last L frames of that vehicle and of its leader, the first frame standing for
    those before, and chooses parameters every `windows.stride` steps *of that vehicle*. Vehicles
    whose window begins are one batch. That is the closed loop in which cfx evaluates a policy; what
    is compiled rounds exponentials and powers otherwise in their last bits. A vehicle that was not
    stepped one time step ago, or had no leader, begins anew.

    Without a leader within `look_ahead` the policy's own model drives with the parameters to which
    the policy fades outside what it has learned, to the lane's limit: a car-following policy has
    never seen a free road. After a change of leader the vehicle goes on: the policy sees the new
    leader from then on.

    The simulation may step by 0.01 to 1 s, whatever the policy's time step is. In a longer step the
    model takes several, together with those of the leaders that it drives too; another leader goes
    on as it accelerates, and histories are corrected as soon as it is known what it did. In shorter
    steps each acceleration is held until a time step of the policy has passed.

    The lane's limit and the vehicle's `maxSpeed` hold as they do around SUMO's own models. With the
    default `speed_mode` 31 SUMO's checks bound each speed: red lights, stops, who yields at
    junctions, and SUMO's own safe gap. With `speed_mode=0` nothing else of SUMO's changes the
    speed: what the model says is driven to the last bits, so vehicles run red lights, pass their
    stops and do not yield. That is meant for replays of recordings and roads
    without junctions. Lane changes are SUMO's.

    Where two lanes become one by turns, a vehicle lets whoever is ahead on the other lane go first
    (`cfx_sumo.live.zippers`), unless the speed mode leaves out who goes first (bit 8).

    The model's limits of acceleration hold always (`model.limits`). Where SUMO bounds braking too
    (bit 4 of the speed mode), a vehicle brakes comfortably at most, unless keeping its
    vType's `minGap` needs more: see `needed_deceleration`. Then it brakes as hard as that, by its
    vType's `emergencyDecel` at most, and SUMO's `decel` of the vehicle is raised until it can stop
    with less at the next light, junction or stop (`VehicleControl`).

    A vehicle that `step` is not given any more is SUMO's again, as after `release`: at once in a
    program that steps all its vehicles in one call, at the next instant in one that makes several
    calls.

    A driver holds the state of one simulation. Where time goes back, all its vehicles begin anew;
    several simulations at once need a driver each.
    """

    def __init__(
        self,
        policy: Agent,
        *,
        network: str | None = ANY_DRIVER,
        look_ahead: float = 200.0,
        speed_mode: int = OBEYS_ALL,
        model: DrivingModel | None = None,
        source: str = "this policy",
        seed: int | None = 0,
        average: bool = False,
    ) -> None:
        """Makes a driver.

        Args:
            policy: chooses parameters.
            network: which of its networks drives vehicles that `assign` does not name; None:
                `assign` must name each.
            look_ahead: m; a vehicle farther ahead (bumper to bumper) is no leader.
            speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven: 31 obeys
                lights, stops and junctions and keeps SUMO's safe gap; 0 does none of it.
            model: the driving model; None for the one that the policy was trained for.
            source: where the policy comes from, for messages.
            seed: of what is left to chance, as in `DriverOptions`.
            average: whether every vehicle has the same driver, as in `DriverOptions`.

        Raises:
            DataError: `look_ahead` is no distance; the policy has no such network; or its driving
                model has equations in SUMO only, or may brake harder than a vehicle can.
            ConfigError: an input of the policy reads what SUMO does not give.
        """
        require_no_further_signals(policy.core.inputs, "SUMO")
        if not look_ahead > 0:
            raise DataError(
                f"look_ahead={look_ahead:g}: give a distance above 0 m within which a leader counts"
            )
        policy = policy.for_live_driving()
        self.policy = policy
        self.look_ahead = look_ahead
        self.source = source
        self.model = model or cast(DrivingModel, registry.create("model", policy.model_node))
        check_model(self.model, policy.model_node["name"], source)
        self.counts = DriveCounts()
        of_drivers = None if average else seed
        self._draws_drivers = of_drivers is not None
        self._assignments = Assignments(policy, network, source, of_drivers)
        self._vehicles = KnownVehicles(policy, policy.core.head.driven_model(self.model))
        self._histories = Histories(self._vehicles)
        self._windows = PolicyWindows(policy, self._vehicles, self._assignments, seed)
        self._model_steps = ModelSteps(
            policy, self.model, self._vehicles, bounds_braking=bool(speed_mode & _BOUNDS_BRAKING)
        )
        self._control = VehicleControl(speed_mode)
        self._roster = Roster()
        self._swept = math.nan
        self._now = -math.inf
        self._clock: Clock | None = None
        self._zippers: Zippers | None = None
        self._view: View | None = None
        self._last = LastDrive()

    @classmethod
    def load(
        cls,
        run: str | Path,
        *,
        network: str | None = ANY_DRIVER,
        model: str | None = None,
        **options: Unpack[DriverOptions],
    ) -> Driver:
        """Reads a job's policy.

        Args:
            run: a job's output folder (or its `policy` folder), or the id of its MLflow run.
            network: which of the policy's networks drives: `all`, which drives any driver's
                vehicle, or the id of a pair, to drive like its driver.
            model: refuse a policy of another driving model than this.
            options: as in `DriverOptions`.

        Raises:
            DataError: there is no such policy, it has no such network, or it is one of another
                model.
        """
        policy = load_policy(run)
        name = policy.model_node["name"]
        if model is not None and name != model:
            raise DataError(
                f"{run} was trained for model={name}, not for model={model}; name a run with"
                f" model={model}"
            )
        return cls(policy, network=network, source=str(run), **options)

    @classmethod
    def constant(
        cls,
        model: DrivingModel,
        parameters: Mapping[str, float] | None = None,
        *,
        dt: float = 0.1,
        **options: Unpack[DriverOptions],
    ) -> Driver:
        """Makes a driver with constant parameters: what a policy is compared with.

        Args:
            model: the driving model.
            parameters: name -> value, SI units; the others at their defaults.
            dt: time step of the model, s.
            options: as in `DriverOptions`.

        Raises:
            ParameterError: the model has no such parameter.
        """
        policy = constant_policy(model, parameters or {}, dt)
        return cls(policy, model=model, source="the constant driver", **options)

    @property
    def vehicles(self) -> tuple[str, ...]:
        """The vehicles that are driven or watched now."""
        return tuple(self._vehicles.names)

    def assign(
        self,
        vehicle: str,
        network: str | None = None,
        *,
        base: Mapping[str, float] | None = None,
        driver_features: Mapping[str, float] | None = None,
    ) -> None:
        """Says how a vehicle is driven from when it begins.

        Args:
            vehicle: its id.
            network: which of the policy's networks drives it; None for this driver's.
            base: calibrated parameters of a driver, name -> SI value, from which the offsets of a
                policy of offsets (`learner=rollout`) start, shrunk towards the default as in
                training;
                None: the policy's base for unseen drivers. Policies that answer parameters
                    themselves
                ignore it.
            driver_features: name -> value, where the policy was trained to read some
                (`policy.driver_features`; `cfx.plugin.driver_features_of` measures them); None:
                those of an unseen driver. What a vehicle does while it is watched does not change
                them.

        Raises:
            DataError: the policy has no such network.
            ParameterError: `base` is not a value for each tuned parameter, or `driver_features` not
                one for each driver feature of the policy.
        """
        self._assignments.assign(vehicle, network, base, driver_features)

    def renew(self, vehicle: str) -> None:
        """Lets the policy's memory of a vehicle begin anew; the frames of its last window stay."""
        row = self._vehicles.row(vehicle)
        if row is not None:
            self._windows.renew(row)

    @property
    def speed_mode(self) -> int:
        """SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven."""
        return self._control.speed_mode

    def drives(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now; a watched vehicle is not driven."""
        return self._control.drives(vehicle)

    def follows(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now behind a leader."""
        return self.drives(vehicle) and vehicle in self._vehicles.leaders

    def outside_in_words(self) -> str:
        """Returns how much was driven outside what the policy has learned, in words; or ""."""
        return self.counts.outside_in_words(self.policy)

    def fleet_in_words(self) -> str:
        """Returns who drives the vehicles: recorded drivers, or the average one; and for what."""
        drivers = self.policy.trained_on.drivers
        words = (
            "all vehicles have one average driver; the policy knows no recorded ones"
            " (policy.driver_features=all trains one that does)"
        )
        if drivers is not None and self._draws_drivers:
            words = (
                f"each vehicle draws one of {len(drivers.weight)} recorded drivers, by its id and"
                " the seed"
            )
        elif drivers is not None:
            words = "all vehicles have one average driver"
        return words

    def time_gaps(self, vehicles: Iterable[str]) -> Tensor:
        """Returns the time gaps of those that the model drives faster than walking, `(d,)`, s."""
        following = (name for name in vehicles if self.follows(name))
        return self._histories.time_gaps(self._vehicles.rows(following))

    def looked_at(self) -> View | None:
        """Returns what the last call of `step` saw, if it drove all vehicles that it was given.

        None before the first call, after one that watched, and in steps shorter than the policy's,
        between two of which vehicles hold their acceleration.
        """
        return self._view

    def gap_to(self, vehicle: str, leader: str) -> float | None:
        """Returns the gap at the last step, bumper to bumper, m; None behind another or nobody."""
        row = self._vehicles.row(vehicle)
        if row is None or self._vehicles.leaders.get(vehicle) != leader:
            return None
        return self._histories.gap(row)

    def parameters(self, vehicle: str) -> dict[str, float]:
        """Returns the parameters of a vehicle now, SI units; empty if the policy drives it not."""
        row, table = self._vehicles.row(vehicle), self._vehicles.table
        if row is None or not bool(table.driven[row]):
            return {}
        return dict(zip(self.policy.space.names, table.parameters[row].tolist(), strict=True))

    @torch.no_grad()
    @threads.one_thread()
    def step(
        self, connection: Connection, vehicles: str | Iterable[str], *, drive: bool = True
    ) -> None:
        """Sets the speeds of vehicles in the next `simulationStep`; call it after each.

        Args:
            connection: `libsumo`, `traci` or one of its connections.
            vehicles: one id or many.
            drive: False only watches, so that the policy knows the history of a vehicle when it
                takes over from another driver.

        Raises:
            SumoError: a vehicle is not in the simulation or acts less often than it steps, the
                simulation steps by less than 0.01 s or more than 1 s, or integrates ballistically.
        """
        for _ in self.in_turns(connection, vehicles, drive=drive):
            pass

    def in_turns(
        self,
        connection: Connection,
        vehicles: str | Iterable[str],
        together: Together | None = None,
        *,
        drive: bool = True,
    ) -> Iterator[None]:
        """Does what `step` does, and stops where other drivers of the simulation take their turn.

        That is after each step of the model in a longer one of the simulation.

        Args:
            connection: as for `step`.
            vehicles: as for `step`.
            together: what all drivers of the simulation expect, where this is not the only one.
            drive: as for `step`.

        Raises:
            SumoError: as `step`.
        """
        names = [vehicles] if isinstance(vehicles, str) else list(vehicles)
        now = connection.simulation.getTime()
        clock = self._clock_of(connection)
        if now < self._now:
            self._forget_all()
        is_new = now != self._now
        self._now = now
        self._forget_departed(connection, now)
        self._let_go(connection, names if drive else [], names, is_new=is_new)
        names, rows = self._rows_for(connection, names, now)
        between: list[str] = []
        if not self._last.goes_on(names, now, clock):
            names, between, rows = self._due(names, rows, now, clock)
        view = look(connection, names, self.look_ahead, self._last.view)
        self._view = view if drive and not between else None
        if not drive:
            self._last = LastDrive()
            self._watch(connection, view, rows[view.arrangement.order], now, clock)
            return
        self._hold(connection, between, now, clock)
        yield from self._drive(connection, view, rows, now, clock, together)

    def _due(
        self, names: list[str], rows: Tensor, now: float, clock: Clock
    ) -> tuple[list[str], list[str], Tensor]:
        """Leaves vehicles out whose time has not come, in steps shorter than the model's.

        Returns:
            Those whose time has come, those that go on meanwhile, and the rows of the first.
        """
        times = self._vehicles.table.time.numpy()[rows.numpy()]
        early = now - times < clock.period - 0.5 * clock.dt
        if not early.any():
            return names, [], rows
        between = list(compress(names, (early & (times != now)).tolist()))
        return list(compress(names, (~early).tolist())), between, rows[torch.from_numpy(~early)]

    def _hold(self, connection: Connection, names: list[str], now: float, clock: Clock) -> None:
        """Lets vehicles go on as they accelerate, in the steps between two of the model."""
        driven = [name for name in names if self.drives(name)]
        if not driven:
            return
        table, rows = self._vehicles.table, self._vehicles.rows(driven)
        passed = now + clock.dt - table.time[rows]
        table.told[rows] = table.start[rows] + table.ramp[rows] * passed
        set_speeds(connection, driven, table.told[rows].numpy())

    def _drive(
        self,
        connection: Connection,
        view: View,
        rows: Tensor,
        now: float,
        clock: Clock,
        together: Together | None,
    ) -> Iterator[None]:
        """Lets the model take its steps until the next look, and tells SUMO where they lead."""
        names, count = view.names, len(view.following)
        if not names:
            self._control.bound_braking(connection, names, {})
            return
        table, (rows, seen) = (
            self._vehicles.table,
            self._take_up(connection, view, rows, now, clock),
        )
        following, at = rows[:count], rows.numpy()
        first = speed = seen.speed.numpy()
        hardest = np.zeros_like(first)
        turns = self._turns(connection, names, seen)
        for number in range(clock.substeps):
            if number > 0:
                self._histories.append(following, seen)
            self._windows.choose(following, view.following, now + number * clock.step, clock)
            table.steps.numpy()[at[:count]] += 1
            self.counts.add(table.score.numpy()[at[:count]], table.beyond, following)
            letting = self._letting_go_first(turns, rows, clock.step)
            taken = self._model_steps.take(connection, names, rows, seen, clock.step)
            speed = taken.speed
            if turns is not None:
                speed = np.minimum(speed, letting)
                of_turns = torch.from_numpy(speed)[turns.places]
                turns = turns.one_step_later(of_turns, clock.step)
            self.counts.limited += int(np.count_nonzero(taken.is_limited[:count]))
            if taken.bound is not None:
                hardest = np.maximum(hardest, taken.bound)
            if clock.substeps == 1:
                break
            after, others = torch.from_numpy(speed), dict[str, float]()
            if together is not None:
                others = together.setdefault((clock.substeps, number), {})
                others.update(zip(names, speed.tolist(), strict=True))
                yield
            seen = seen.one_step_later(after, clock.step, view.leader_speeds(after, others))
        if clock.substeps > 1:
            table.expected[rows] = frame_of(seen)
        self.counts.free += clock.substeps * len(view.alone)
        self._tell(connection, names, at, first, speed, hardest, clock)
        self._last = LastDrive(view, rows, now)

    def _turns(self, connection: Connection, names: list[str], seen: Seen) -> Turns | None:
        """Finds the vehicles that let others go first at zippers; None: none does.

        Args:
            connection: to the simulation.
            names: the D vehicles.
            seen: what they do.
        """
        if not self.speed_mode & _YIELDS:
            return None
        if self._zippers is None:
            self._zippers = Zippers(connection)
        if not self._zippers.lanes:
            return None
        return self._zippers.turns(connection, names, seen)

    def _letting_go_first(self, turns: Turns | None, rows: Tensor, dt: float) -> _Floats | float:
        """Returns the highest speeds with which vehicles let others go first, `(D,)`, m/s.

        Args:
            turns: whom they let go first.
            rows: of the D vehicles, `(D,)` int64.
            dt: a step of the model, s.
        """
        if turns is None:
            return math.inf
        speed = np.full(len(rows), np.inf)
        behind = self._model_steps.behind(rows[turns.places], turns.seen, dt)
        easily = turns.seen.speed - EASY_MPS2 * dt
        speed[turns.places.numpy()] = torch.maximum(behind, easily).numpy()
        return speed

    def _take_up(
        self, connection: Connection, view: View, rows: Tensor, now: float, clock: Clock
    ) -> tuple[Tensor, Seen]:
        """Puts what was seen into the vehicles' rows, and begins those that are new.

        Returns:
            The rows in the view's order, `(D,)` int64, and what all vehicles do.
        """
        table, last, count = self._vehicles.table, self._last, len(view.following)
        unchanged = last.goes_on(view.arrangement.requested, now, clock) and last.is_arranged(view)
        rows = last.rows if unchanged else rows[view.arrangement.order]
        # Until all is done nothing is known of this call: it may end in an error.
        self._last = LastDrive()
        going = None
        if not unchanged:
            going = self._histories.goes_on(rows, now, clock)
        self.counts.add_told(table.told.numpy()[rows.numpy()], view.seen.speed.numpy(), going)
        seen = self._remember(rows[:count], view, going, now, clock)
        if view.alone:
            self._begin_free(rows[count:], view.alone, going, now)
        if not unchanged:
            self._take_over(connection, view.names, rows, seen, clock)
        return rows, seen

    def _tell(
        self,
        connection: Connection,
        names: list[str],
        at: _Places,
        first: _Floats,
        speed: _Floats,
        hardest: _Floats,
        clock: Clock,
    ) -> None:
        """Tells SUMO the next speeds of vehicles, and how hard they must be able to brake.

        Args:
            connection: to the simulation.
            names: the D vehicles.
            at: their rows, `(D,)`.
            first: their speeds now, `(D,)`, m/s.
            speed: those at the next look, `(D,)`, m/s.
            hardest: how hard they must be able to brake, `(D,)`, m/s2; 0: comfortably is enough.
            clock: of the simulation.
        """
        table, ramp = self._vehicles.table, (speed - first) / clock.period
        table.start.numpy()[at], table.ramp.numpy()[at] = first, ramp
        told = speed
        if clock.held > 1:
            told = first + ramp * clock.dt
        table.told.numpy()[at] = told
        brakes_hard: dict[str, float] = {}
        for index in np.flatnonzero(hardest).tolist():
            brakes_hard[names[index]] = float(hardest[index])
        self._control.bound_braking(connection, names, brakes_hard)
        set_speeds(connection, names, told)

    def _watch(
        self, connection: Connection, view: View, rows: Tensor, now: float, clock: Clock
    ) -> None:
        """Lets the policy see vehicles that somebody else drives."""
        for name in view.alone:
            self.release(connection, name)
        if not view.following:
            return
        count = len(view.following)
        rows = rows[:count]
        going = self._histories.goes_on(rows, now, clock)
        seen = self._remember(rows, view, going, now, clock).rows(slice(count))
        table = self._vehicles.table
        for number in range(clock.substeps):
            if number > 0:
                self._histories.append(rows, seen)
            self._windows.observe(rows, clock)
            table.steps[rows] += 1
            speed = (seen.speed + seen.acceleration * clock.step).clamp(min=0.0)
            seen = seen.one_step_later(speed, clock.step)
        table.expected[rows] = frame_of(seen)

    def _remember(
        self, rows: Tensor, view: View, going: Tensor | None, now: float, clock: Clock
    ) -> Seen:
        """Puts this instant into the histories of followers; begins those that are new.

        Args:
            rows: of the F followers, who stand first in the view.
            view: all D vehicles.
            going: which of the D vehicles were looked at one period ago, bool `(D,)`; None: all,
                and followers were followers.
            now: s.
            clock: of the simulation.

        Returns:
            What all D vehicles do, with accelerations as over a step of the model.
        """
        seen, new = self._histories.remember(rows, view, going, now, clock)
        if len(new) > 0:
            self._windows.begin(rows[new], [view.following[number] for number in new.tolist()])
        return seen

    def _begin_free(self, rows: Tensor, names: list[str], going: Tensor | None, now: float) -> None:
        """Begins vehicles that have no leader any more, or have just come.

        Args:
            rows: of the vehicles, `(A,)` int64.
            names: their ids.
            going: as for `_remember`; these are the last of the D vehicles.
            now: s.
        """
        table = self._vehicles.table
        table.time[rows] = now
        if going is None:
            return
        new = (~(going[-len(rows) :] & table.free[rows])).nonzero().flatten()
        if len(new) == 0:
            return
        beginning = [names[number] for number in new.tolist()]
        for name in beginning:
            self._vehicles.leaders.pop(name, None)
        self._windows.begin_free(rows[new], beginning)

    def _take_over(
        self, connection: Connection, names: list[str], rows: Tensor, seen: Seen, clock: Clock
    ) -> None:
        """Drives from here on the vehicles that begin, with a new window and memory."""
        table = self._vehicles.table
        for index in np.flatnonzero(~table.driven.numpy()[rows.numpy()]).tolist():
            name, row = names[index], int(rows[index])
            acts = connection.vehicle.getActionStepLength(name)
            if acts > clock.dt + 1e-6:
                raise SumoError(
                    f"vehicle '{name}' acts every {acts:g} s (actionStepLength) in steps of"
                    f" {clock.dt:g} s, and a driver acts in each; leave actionStepLength out of its"
                    f" vType, or start SUMO with --step-length {acts:g}"
                )
            table.driven[row] = True
            table.steps[row] = 0
            self._model_steps.begin(row, seen.speed[index])
            self._control.take(connection, name)

    def save_state(self, path: str | Path) -> None:
        """Writes what is known of all vehicles, for a simulation that goes on from here.

        SUMO's own state of the same instant (`simulation.saveState`) belongs to it; SUMO writes it
        exactly with `--save-state.precision 17 --save-state.rng true`. Without its random numbers
        SUMO's own drivers go on differently, by their `sigma`.

        Args:
            path: of the file.

        Raises:
            OutputError: the file cannot be written.
        """
        write_state(Path(path), [self.record()])

    def load_state(self, connection: Connection, path: str | Path) -> None:
        """Goes on from what `save_state` wrote; call it after SUMO's `simulation.loadState`.

        Args:
            connection: to a simulation at the instant at which the state was saved.
            path: of the file.

        Raises:
            DataError: there is no such file, or it is of another policy.
            SumoError: the simulation is at another time, or lacks one of the vehicles.
        """
        drivers, _ = read_state(Path(path))
        if len(drivers) != 1:
            raise DataError(f"{path} holds the state of a fleet; load it with Fleet.load_state")
        self.go_on(connection, drivers[0], str(path))

    def record(self) -> DriverRecord:
        """Returns all that is known of the vehicles."""
        names = list(self._vehicles.names)
        described = {
            "now": self._now,
            "policy": self._identity(),
            "vehicles": names,
            "leaders": self._vehicles.leaders,
            "control": self._control.described(),
            **self._roster.described(),
            **self._assignments.described(),
        }
        return DriverRecord(described, self._vehicles.table.columns_of(self._vehicles.rows(names)))

    def go_on(self, connection: Connection, record: DriverRecord, source: str) -> None:
        """Goes on from a record in a simulation that stands where it was made.

        Args:
            connection: to the simulation.
            record: of a driver of the same policy.
            source: where the record comes from, for messages.

        Raises:
            DataError: the record is of another policy.
            SumoError: the simulation is at another time, or lacks one of the vehicles.
        """
        described, columns = record
        if described["policy"] != self._identity():
            raise DataError(
                f"{source} is of a driver with another policy than {self.source}; load it with the"
                " policy that it was saved with"
            )
        now = connection.simulation.getTime()
        if abs(now - described["now"]) > 1e-6:
            raise SumoError(
                f"{source} was saved at {described['now']:g} s, the simulation is at {now:g} s;"
                " load SUMO's state of that instant first (simulation.loadState)"
            )
        names = described["vehicles"]
        missing = sorted(set(names) - set(connection.vehicle.getIDList()))
        if missing:
            raise SumoError(
                f"{source} has vehicle '{missing[0]}', which the simulation lacks; load SUMO's"
                " state of the same run first (simulation.loadState)"
            )
        self._forget_all()
        self._now = now
        rows = self._vehicles.add(names)
        self._vehicles.table.put_columns(rows, columns)
        self._vehicles.leaders = dict(described["leaders"])
        self._roster.go_on(described)
        self._assignments.go_on(described)
        self._control.go_on(connection, described["control"])
        driven = list(self._control.driven)
        told = self._vehicles.table.told[self._vehicles.rows(driven)]
        set_speeds(connection, driven, told.numpy())

    def _identity(self) -> list[object]:
        """Returns what policies must share to go on from one another's state."""
        windows = self.policy.windows
        return [
            self.policy.model_node["name"],
            list(self.policy.space.names),
            list(self.policy.names),
            [windows.length, windows.stride, self.policy.dt],
        ]

    def forget(self, vehicle: str) -> None:
        """Drops all that is known of a vehicle; SUMO keeps the last speed that it was given."""
        self._control.forget(vehicle)
        self._drop(vehicle)

    def _drop(self, vehicle: str) -> None:
        """Drops what was seen of a vehicle."""
        self._vehicles.drop(vehicle)
        self._roster.forget(vehicle)

    def _forget_all(self) -> None:
        """Drops all vehicles: time went back, so this is another simulation or an earlier state."""
        for vehicle in self.vehicles:
            self.forget(vehicle)
        self._swept = math.nan
        self._clock = self._zippers = None
        self._last = LastDrive()
        self._roster.clear()

    def release(self, connection: Connection, vehicle: str) -> None:
        """Hands a vehicle back to SUMO's own model and drops what is known of it.

        Where it brakes hard for a light, a stop or a junction, SUMO's `decel` of it stays raised
        until later steps of this driver can lower it.
        """
        self._control.give_back(connection, vehicle)
        self._drop(vehicle)

    def _let_go(
        self, connection: Connection, given: list[str], names: list[str], *, is_new: bool
    ) -> None:
        """Hands vehicles back to SUMO that are driven and not given any more.

        That is at once for a program that steps all its vehicles in one call. One that makes
        several calls at an instant may give a vehicle in a later one: then it is when the next
        instant comes.

        Args:
            connection: to the simulation.
            given: vehicles that this call drives.
            names: vehicles that it names, to drive or to watch them.
            is_new: whether this is the first call at this instant.
        """
        if not is_new:
            self._roster.add(given)
            return
        before = self._roster.begin_instant(given)
        if len(self._control.driven) == len(before) and self._vehicles.were_last(given):
            return
        self._forget_gone(connection, names, self._now)
        for name in self._control.driven - (before | self._roster.given):
            self.release(connection, name)

    def _clock_of(self, connection: Connection) -> Clock:
        """Returns how the model's steps fit into the simulation's.

        Raises:
            SumoError: they do not, or SUMO integrates otherwise than the model does.
        """
        dt = connection.simulation.getDeltaT()
        if self._clock is None or self._clock.dt != dt:
            if connection.simulation.getOption("step-method.ballistic") == "true":
                raise SumoError(
                    "the simulation integrates ballistically, the driving models do not; start SUMO"
                    " without --step-method.ballistic"
                )
            self._clock = Clock.of(dt, self.policy.dt, self.source)
        return self._clock

    def _forget_departed(self, connection: Connection, now: float) -> None:
        """Drops vehicles that have just departed: another vehicle had that id a step ago."""
        for name in connection.simulation.getDepartedIDList():
            row = self._vehicles.row(name)
            if row is not None and float(self._vehicles.table.time[row]) != now:
                self.forget(name)

    def _rows_for(
        self, connection: Connection, names: list[str], now: float
    ) -> tuple[list[str], Tensor]:
        """Returns vehicles and their rows, `(D,)` int64, and drops those that have left."""
        if not self._vehicles.were_last(names) or len(names) != len(self._vehicles.names):
            self._forget_gone(connection, names, now)
        return self._vehicles.rows_again(names)

    def _forget_gone(self, connection: Connection, names: list[str], now: float) -> None:
        """Drops vehicles that have left.

        That is looked for once an instant, and only if `names` leaves some vehicles unaccounted
        for.
        """
        if self._swept == now or self._vehicles.names <= set(names):
            return
        self._swept = now
        for gone in self._vehicles.names - set(connection.vehicle.getIDList()):
            self.forget(gone)
            self._assignments.forget(gone)
