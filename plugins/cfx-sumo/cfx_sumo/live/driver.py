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
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import TypedDict, Unpack, cast

import torch
from torch import Tensor

from cfx.errors import DataError, ParameterError, SumoError
from cfx.plugin import (
    ANY_DRIVER,
    Agent,
    AgentCore,
    AgentState,
    ConstantNetwork,
    DirectHead,
    DriverContext,
    DrivingModel,
    FixedPolicy,
    Follower,
    History,
    Leader,
    Scaler,
    WindowSettings,
    advance_vehicle,
    at_limits,
    create,
    folder_of,
    one_thread,
    parse_json,
    share_in_words,
)
from cfx.plugin import load_agent as load_checkpoint
from cfx_sumo.live.braking import hardest_braking
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.control import VehicleControl
from cfx_sumo.live.draws import standard_normal
from cfx_sumo.live.orders import set_speeds
from cfx_sumo.live.saved import DriverRecord, read_state, write_state
from cfx_sumo.live.surroundings import Connection, Seen, View, look
from cfx_sumo.live.vehicles import VehicleTable

_BOUNDS_BRAKING = 4
"""Bit of SUMO's speed mode with which a vehicle brakes no harder than its `decel`."""

_BLOCK = 1024
"""Vehicles for which the networks answer at once: what more of them need exceeds the processor's
caches, and takes twice as long for each."""

_OBEYED_MPS = 1e-3
"""A speed this close to what SUMO was told is what it was told."""

Together = dict[tuple[int, int], dict[str, float]]
"""Speeds of vehicles, m/s, that drivers of one simulation expect within a step of it: by how many
steps their models take in it, and which of these it is."""

_WALKING_MPS = 1.5
"""Speed below which a time gap means nothing."""

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
    """

    look_ahead: float
    speed_mode: int
    seed: int | None


@dataclass
class DriveCounts:
    """What a driver did over all steps of all its vehicles.

    Attributes:
        steps: steps of the model behind a leader.
        outside: those of them that began outside what the policy has learned from.
        limited: those at a limit of acceleration.
        beyond: in how many each signal alone was too low, then too high; None before the first.
        free: steps of the model without a leader.
        told: speeds that SUMO was told and whose result was seen.
        changed: those of them that SUMO changed, by the checks that the speed mode leaves it.
    """

    steps: int = 0
    free: int = 0
    told: int = 0
    changed: int = 0
    outside: int = 0
    limited: int = 0
    beyond: Tensor | None = None

    def add(self, score: Tensor, beyond: Tensor) -> None:
        """Counts one step of D vehicles: scores `(D,)`, unusual signals `(D, 2 f)`."""
        is_outside = score > 1.0
        self.steps += len(score)
        self.outside += int(is_outside.sum())
        found = beyond[is_outside].sum(0)
        self.beyond = found if self.beyond is None else self.beyond + found


_LEADER_SPEED, _LEADER_ACCELERATION, _SPEED, _ACCELERATION, _GAP = range(len(History._fields))
"""Rows of a history."""


def _frame(seen: Seen) -> Tensor:
    """Returns one frame of a history, `(D, 5)`."""
    history = History(
        seen.leader_speed, seen.leader_acceleration, seen.speed, seen.acceleration, seen.gap
    )
    return torch.stack(list(history), 1)


def _is_limited(model: DrivingModel, before: Tensor, after: Tensor, dt: float) -> Tensor:
    """Says which vehicles are at a limit of acceleration, bool `(D,)`, of speeds in m/s."""
    return at_limits(model.limits, torch.stack([before, after], -1), dt)[:, 1]


class Driver:
    """Drives any number of vehicles with the policy of one job.

        driver = Driver.load("outputs/my-job")
        connection.simulationStep()
        driver.step(connection, vehicle_ids)

    Life cycle of a vehicle: it is driven from the first `step` that names it. Behind a leader the
    policy sees the last L frames of that vehicle and of its leader, the first frame standing for
    those before, and chooses parameters every `windows.stride` steps *of that vehicle*. Vehicles
    whose window begins are one batch. That is the closed loop in which cfx evaluates a policy, to
    the last bits. A vehicle that was not stepped one time step ago, or had no leader, begins anew.

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
            seed: of what a stochastic policy leaves to chance, as in `DriverOptions`.

        Raises:
            DataError: `look_ahead` is no distance; the policy has no such network; or its driving
                model has equations in SUMO only, or may brake harder than a vehicle can.
        """
        if not look_ahead > 0:
            raise DataError(
                f"look_ahead={look_ahead:g}: give a distance above 0 m within which a leader counts"
            )
        self.policy = policy
        self.look_ahead = look_ahead
        self.source = source
        self.model = model or cast(DrivingModel, create("model", policy.model_node))
        if self.model.needs_simulator:
            raise DataError(
                f"{source} chooses parameters of model={policy.model_node['name']}, which SUMO"
                " alone drives: they cannot be changed on the way; a live driver needs a model that"
                " cfx has, such as krauss or w99"
            )
        if not self.model.brakes_within_bounds:
            raise DataError(
                f"{source}: its driving model has neither limits nor a brake cap, so it may brake"
                " harder than a vehicle can; train it with model.limits as they are by default"
                " (or model.variant=sumo) to drive live"
            )
        self._driven = policy.head.driven_model(self.model)
        self._seed = seed
        self._network = None
        if network is not None:
            self._network = self._number(network)
        self._assigned: dict[str, int] = {}
        self._bases: dict[str, list[float]] = {}
        self._driver_features: dict[str, list[float]] = {}
        self._control = VehicleControl(speed_mode)
        self._given: set[str] = set()
        self._calls = 0
        self.counts = DriveCounts()
        self._leaders: dict[str, str] = {}
        self._slots: dict[str, int] = {}
        self._unused: list[int] = []
        self._asked: list[str] = []
        self._asked_slots = torch.empty(0, dtype=torch.int64)
        self._store = VehicleTable.empty(policy, self._driven, 0)
        self._swept = math.nan
        self._now = -math.inf
        self._clock: Clock | None = None

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
        policy = _load_policy(run)
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
        space = model.space
        values = space.defaults()
        for name, value in (parameters or {}).items():
            if name not in space.names:
                raise ParameterError(
                    f"'{name}' is no tuned parameter of this model; it has {', '.join(space.names)}"
                )
            values[space.names.index(name)] = value
        unit = space.to_unit(values)[None]
        scaler = Scaler(unit.new_zeros((1, 1)), unit.new_ones((1, 1)))
        policy = Agent(
            core=AgentCore(FixedPolicy(), ConstantNetwork(unit), scaler, DirectHead(space)),
            model_node={"name": type(model).__name__},
            policy_node={"name": "fixed"},
            windows=WindowSettings(),
            dt=dt,
            names=(ANY_DRIVER,),
            population=values[None],
        )
        return cls(policy, model=model, source="the constant driver", **options)

    @property
    def vehicles(self) -> tuple[str, ...]:
        """The vehicles that are driven or watched now."""
        return tuple(self._slots)

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
                (`policy.driver_features`; `Agent.driver_features_of` measures them); None: those of
                an unseen driver. What a vehicle does while it is watched does not change them.

        Raises:
            DataError: the policy has no such network.
            ParameterError: `base` is not a value for each tuned parameter, or `driver_features` not
                one for each driver feature of the policy.
        """
        if network is not None:
            self._assigned[vehicle] = self._number(network)
        if base is not None:
            self._bases[vehicle] = self._shrunk_base(base)
        if driver_features is not None:
            self._driver_features[vehicle] = self._ordered_features(driver_features)

    def _shrunk_base(self, base: Mapping[str, float]) -> list[float]:
        names = self.policy.model_space.names
        if set(base) != set(names):
            raise ParameterError(
                f"base: give a value for each of {', '.join(names)}, and nothing else"
            )
        own = torch.tensor([[base[name] for name in names]], dtype=torch.float64)
        shrunk: list[float] = self.policy.base_of(own)[0].tolist()
        return shrunk

    def _ordered_features(self, driver_features: Mapping[str, float]) -> list[float]:
        known = self.policy.core.driver_features
        if not known:
            raise ParameterError(
                "driver_features: this policy was trained to read none; leave them out"
            )
        if set(driver_features) != set(known):
            raise ParameterError(
                f"driver_features: give a value for each of {', '.join(known)}, and nothing else"
            )
        return [driver_features[name] for name in known]

    def renew(self, vehicle: str) -> None:
        """Lets the policy's memory of a vehicle begin anew; the frames of its last window stay."""
        slot = self._slots.get(vehicle)
        if slot is not None:
            begun = self._begun(torch.tensor([slot]))
            self._store.state[slot] = begun.state[begun.network, begun.place][0]

    @property
    def speed_mode(self) -> int:
        """SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven."""
        return self._control.speed_mode

    def drives(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now; a watched vehicle is not driven."""
        return self._control.drives(vehicle)

    def follows(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now behind a leader."""
        return self.drives(vehicle) and vehicle in self._leaders

    def outside_in_words(self) -> str:
        """Returns how much was driven outside what the policy has learned, in words; or ""."""
        valid_range, counts = self.policy.valid_range, self.counts
        if valid_range is None or counts.beyond is None:
            return ""
        return share_in_words(valid_range, counts.outside, counts.steps, counts.beyond)

    def time_gaps(self, vehicles: Iterable[str]) -> Tensor:
        """Returns the time gaps of those that the model drives faster than walking, `(d,)`, s."""
        slots = self._slots_of(name for name in vehicles if self.follows(name))
        history = self._store.history[slots, :, -1]
        gap = history[:, History._fields.index("gap")]
        speed = history[:, History._fields.index("follower_speed")]
        return (gap / speed)[speed > _WALKING_MPS]

    def gap_to(self, vehicle: str, leader: str) -> float | None:
        """Returns the gap at the last step, bumper to bumper, m; None behind another or nobody."""
        slot = self._slots.get(vehicle)
        if slot is None or self._leaders.get(vehicle) != leader:
            return None
        return float(self._store.history[slot, History._fields.index("gap"), -1])

    def parameters(self, vehicle: str) -> dict[str, float]:
        """Returns the parameters of a vehicle now, SI units; empty if the policy drives it not."""
        slot = self._slots.get(vehicle)
        if slot is None or not bool(self._store.driven[slot]):
            return {}
        values = self._store.parameters[slot].tolist()
        return dict(zip(self.policy.space.names, values, strict=True))

    @torch.no_grad()
    @one_thread()
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
        slots = self._asked_for(connection, names, now)
        times = self._store.time[slots]
        early = now - times < clock.period - 0.5 * clock.dt
        between: list[str] = []
        if bool(early.any()):
            between = list(compress(names, (early & (times != now)).tolist()))
            names, slots = list(compress(names, (~early).tolist())), slots[~early]
        view = look(connection, names, self.look_ahead)
        slots = slots[view.order]
        if drive:
            self._hold(connection, between, now, clock)
            yield from self._drive(connection, view, slots, now, clock, together)
        else:
            self._watch(connection, view, slots, now, clock)

    def _hold(self, connection: Connection, names: list[str], now: float, clock: Clock) -> None:
        """Lets vehicles go on as they accelerate, in the steps between two of the model."""
        driven = [name for name in names if self.drives(name)]
        if not driven:
            return
        store, slots = self._store, self._slots_of(driven)
        passed = now + clock.dt - store.time[slots]
        store.told[slots] = store.start[slots] + store.ramp[slots] * passed
        set_speeds(connection, driven, store.told[slots].numpy())

    def _drive(
        self,
        connection: Connection,
        view: View,
        slots: Tensor,
        now: float,
        clock: Clock,
        together: Together | None,
    ) -> Iterator[None]:
        """Lets the model take its steps until the next look, and tells SUMO where they lead."""
        names = [*view.following, *view.alone]
        if not names:
            self._control.bound_braking(connection, names, {})
            return
        count = len(view.following)
        store = self._store
        following = slots[:count]
        self._count_changed(slots, view.seen, now, clock)
        seen = self._remember(following, view, now, clock)
        self._begin_free(slots[count:], view.alone, now, clock)
        self._take_over(connection, names, slots, seen, clock)
        first, hardest = seen.speed, torch.zeros_like(seen.speed)
        for number in range(clock.substeps):
            if number > 0:
                self._append(following, seen.rows(slice(count)))
            due = store.steps[following] % self._stride(clock) == 0
            self._choose(following, view.following, due, now + number * clock.step)
            store.steps[following] += 1
            self.counts.add(store.score[following], store.beyond[following])
            speed, bound = self._speeds(connection, names, slots, seen, clock.step)
            limited = _is_limited(self.model, seen.speed[:count], speed[:count], clock.step)
            self.counts.limited += int(limited.sum())
            hardest = torch.maximum(hardest, bound)
            leaders = None
            if clock.substeps > 1:
                others: dict[str, float] = {}
                if together is not None:
                    others = together.setdefault((clock.substeps, number), {})
                    others.update(zip(names, speed.tolist(), strict=True))
                    yield
                leaders = view.leader_speeds(speed, others)
            seen = seen.one_step_later(speed, clock.step, leaders)
        self.counts.free += clock.substeps * len(view.alone)
        store.expected[slots] = _frame(seen)
        store.start[slots], store.ramp[slots] = first, (seen.speed - first) / clock.period
        told = seen.speed
        if clock.held > 1:
            told = first + store.ramp[slots] * clock.dt
        store.told[slots] = told
        brakes_hard = {}
        for index in hardest.nonzero().flatten().tolist():
            brakes_hard[names[index]] = float(hardest[index])
        self._control.bound_braking(connection, names, brakes_hard)
        set_speeds(connection, names, told.numpy())

    def _watch(
        self, connection: Connection, view: View, slots: Tensor, now: float, clock: Clock
    ) -> None:
        """Lets the policy see vehicles that somebody else drives."""
        for name in view.alone:
            self.release(connection, name)
        if not view.following:
            return
        count = len(view.following)
        slots = slots[:count]
        seen = self._remember(slots, view, now, clock).rows(slice(count))
        store = self._store
        for number in range(clock.substeps):
            if number > 0:
                self._append(slots, seen)
            self._observe(slots[store.steps[slots] % self._stride(clock) == 0])
            store.steps[slots] += 1
            speed = (seen.speed + seen.acceleration * clock.step).clamp(min=0.0)
            seen = seen.one_step_later(speed, clock.step)
        store.expected[slots] = _frame(seen)

    def _count_changed(self, slots: Tensor, seen: Seen, now: float, clock: Clock) -> None:
        """Counts the vehicles that do not drive as SUMO was told."""
        store = self._store
        obliged = self._goes_on(slots, now, clock) & ~store.told[slots].isnan()
        changed = (seen.speed - store.told[slots]).abs() > _OBEYED_MPS
        self.counts.told += int(obliged.sum())
        self.counts.changed += int((obliged & changed).sum())

    def _stride(self, clock: Clock) -> int:
        """Returns how many steps of the model a window of the policy takes."""
        return clock.steps_in(self.policy.windows.stride * self.policy.dt)

    def _goes_on(self, slots: Tensor, now: float, clock: Clock) -> Tensor:
        """Says which vehicles were looked at one period ago, bool `(D,)`."""
        return (now - self._store.time[slots] - clock.period).abs() < 0.5 * clock.dt

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
        names = list(self._slots)
        described = {
            "now": self._now,
            "policy": self._identity(),
            "vehicles": names,
            "leaders": self._leaders,
            "control": self._control.described(),
            "given": sorted(self._given),
            "calls": self._calls,
            "assigned": self._assigned,
            "bases": self._bases,
            "driver_features": self._driver_features,
        }
        return DriverRecord(described, self._store.columns_of(self._slots_of(names)))

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
        described, rows = record
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
        slots = self._places(names)
        self._store.put_columns(slots, rows)
        self._leaders = dict(described["leaders"])
        self._given = set(described["given"])
        self._calls = described["calls"]
        self._assigned = dict(described["assigned"])
        self._bases = dict(described["bases"])
        self._driver_features = dict(described["driver_features"])
        self._control.go_on(connection, described["control"])
        driven = list(self._control.driven)
        set_speeds(connection, driven, self._store.told[self._slots_of(driven)].numpy())

    def _identity(self) -> list[object]:
        """Returns what policies must share to go on from one another's state."""
        windows = self.policy.windows
        return [
            self.policy.model_node["name"],
            list(self.policy.space.names),
            list(self.policy.names),
            [windows.length, windows.stride, self.policy.dt],
        ]

    def _slots_of(self, names: Iterable[str]) -> Tensor:
        """Returns the rows of vehicles that are known, `(D,)` int64."""
        return torch.tensor([self._slots[name] for name in names], dtype=torch.int64)

    def forget(self, vehicle: str) -> None:
        """Drops all that is known of a vehicle; SUMO keeps the last speed that it was given."""
        self._control.forget(vehicle)
        self._drop(vehicle)

    def _drop(self, vehicle: str) -> None:
        """Drops what was seen of a vehicle."""
        self._leaders.pop(vehicle, None)
        self._given.discard(vehicle)
        self._asked = []
        slot = self._slots.pop(vehicle, None)
        if slot is not None:
            self._unused.append(slot)

    def _forget_all(self) -> None:
        """Drops all vehicles: time went back, so this is another simulation or an earlier state."""
        for vehicle in self.vehicles:
            self.forget(vehicle)
        self._swept = math.nan
        self._clock = None
        self._given, self._calls = set(), 0

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
            self._calls += 1
            self._given.update(given)
            return
        before, self._given = self._given, set(given)
        if self._calls == 1:
            before = self._given
        self._calls = 1
        if len(self._control.driven) == len(before) and given == self._asked:
            return
        self._forget_gone(connection, names, self._now)
        for name in self._control.driven - (before | self._given):
            self.release(connection, name)

    def _number(self, network: str) -> int:
        names = self.policy.names
        if network in names:
            return names.index(network)
        if network == ANY_DRIVER and len(names) == 1:
            return 0
        if network == ANY_DRIVER:
            raise DataError(
                f"{self.source} has {len(names)} networks, each for one driver ({names[0]}, ...),"
                " and none for unseen drivers; train with protocol.networks=all or"
                " protocol=across_drivers, or name one of them: Driver.load(..., network=...), or"
                f" --drivers TYPE={self.source}#{names[0]}"
            )
        listed = ", ".join(names[:5])
        if len(names) > 5:
            listed += ", ..."
        raise DataError(f"{self.source} has no network '{network}'; it has {listed}")

    def _network_of(self, vehicle: str) -> int:
        """Returns the number of the network that drives a vehicle."""
        number = self._assigned.get(vehicle, self._network)
        if number is None:
            raise DataError(
                f"no network of {self.source} was assigned to vehicle '{vehicle}'; call"
                " assign(vehicle, network) first"
            )
        return number

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
            slot = self._slots.get(name)
            if slot is not None and float(self._store.time[slot]) != now:
                self.forget(name)

    def _asked_for(self, connection: Connection, names: list[str], now: float) -> Tensor:
        """Returns the rows of vehicles, `(D,)` int64, and drops those that have left.

        Mostly the same vehicles are asked for step after step: then nothing is looked up.
        """
        if names != self._asked or len(names) != len(self._slots):
            self._forget_gone(connection, names, now)
            self._asked_slots = self._places(names)
            self._asked = list(names)
        return self._asked_slots

    def _forget_gone(self, connection: Connection, names: list[str], now: float) -> None:
        """Drops vehicles that have left.

        That is looked for once an instant, and only if `names` leaves some vehicles unaccounted
        for.
        """
        if self._swept == now or self._slots.keys() <= set(names):
            return
        self._swept = now
        for gone in self._slots.keys() - set(connection.vehicle.getIDList()):
            self.forget(gone)
            self._assigned.pop(gone, None)
            self._bases.pop(gone, None)
            self._driver_features.pop(gone, None)

    def _places(self, names: list[str]) -> Tensor:
        """Returns the rows of vehicles, `(D,)` int64; a new vehicle gets one."""
        for name in names:
            if name in self._slots:
                continue
            if not self._unused:
                taken = len(self._slots)
                more = VehicleTable.empty(self.policy, self._driven, max(16, taken))
                self._store = self._store.with_rows(more)
                self._unused = list(range(taken, len(self._store.time)))
            self._slots[name] = slot = self._unused.pop()
            self._store.time[slot] = torch.nan  # it has no frame yet
        return self._slots_of(names)

    def _remember(self, slots: Tensor, view: View, now: float, clock: Clock) -> Seen:
        """Puts this instant into the histories of followers; begins those that are new.

        Args:
            slots: of the F followers, who stand first in the view.
            view: all D vehicles.
            now: s.
            clock: of the simulation.

        Returns:
            What all D vehicles do, with accelerations as over a step of the model.
        """
        store, count = self._store, len(slots)
        going = self._goes_on(slots, now, clock) & ~store.free[slots]
        frame = _frame(view.seen)
        if clock.substeps > 1 or clock.held > 1:
            frame[:count] = self._in_model_steps(slots, view, frame[:count], going, clock)
        self._leaders.update(zip(view.following, view.leaders, strict=True))
        seen = view.seen._replace(
            acceleration=frame[:, _ACCELERATION], leader_acceleration=frame[:, _LEADER_ACCELERATION]
        )
        self._append(slots[going], seen.rows(slice(count)).rows(going))
        store.time[slots] = now
        if not bool(going.all()):
            index = (~going).nonzero().flatten()
            new = [view.following[number] for number in index.tolist()]
            self._begin(slots[index], new)
            store.history[slots[index]] = frame[index, :, None]
            begun = self._begun(slots[index])
            store.state[slots[index]] = begun.state[begun.network, begun.place]
            store.latent[slots[index]] = begun.latent
        return seen

    def _in_model_steps(
        self, slots: Tensor, view: View, frame: Tensor, going: Tensor, clock: Clock
    ) -> Tensor:
        """Returns frames `(F, 5)` with accelerations as they are over a step of the model.

        SUMO's are over its own step. In a long one the frames of the model's steps were expected;
        what happened instead is spread over them evenly. A leader that is new was not expected.
        """
        store, frame = self._store, frame.clone()
        same = []
        for name, leader in zip(view.following, view.leaders, strict=True):
            same.append(self._leaders.get(name) == leader)
        known = going & torch.tensor(same, dtype=torch.bool)
        before = store.history[slots, :, -1]
        if clock.held > 1:
            mean = (frame - before) / clock.period
            for speed, acceleration, is_known in (
                (_SPEED, _ACCELERATION, going),
                (_LEADER_SPEED, _LEADER_ACCELERATION, known),
            ):
                frame[:, acceleration] = torch.where(
                    is_known, mean[:, speed], frame[:, acceleration]
                )
            return frame
        error = frame - store.expected[slots]
        error[:, _ACCELERATION] = error[:, _SPEED] / clock.dt
        error[:, _LEADER_ACCELERATION] = error[:, _LEADER_SPEED] / clock.dt
        own = torch.zeros(len(History._fields), dtype=torch.bool)
        own[[_SPEED, _ACCELERATION]] = True
        used = going[:, None] & (own | known[:, None])
        error = torch.where(used, error, 0.0)
        steps = min(clock.substeps - 1, store.history.shape[-1])
        share = torch.arange(clock.substeps - steps, clock.substeps) / clock.substeps
        spread = error[:, :, None] * share
        for row in (_ACCELERATION, _LEADER_ACCELERATION):
            spread[:, row] = error[:, row, None]
        store.history[slots, :, -steps:] += spread
        expected = store.expected[slots] + error
        for row in (_ACCELERATION, _LEADER_ACCELERATION):
            frame[:, row] = torch.where(used[:, row], expected[:, row], frame[:, row])
        return frame

    def _append(self, slots: Tensor, seen: Seen) -> None:
        """Puts a frame of vehicles `(D,)` into their histories, in place of the oldest one."""
        earlier = self._store.history[slots, :, 1:]
        self._store.history[slots] = torch.cat([earlier, _frame(seen)[:, :, None]], -1)

    def _begin(self, slots: Tensor, names: list[str]) -> None:
        """Begins vehicles anew, with what is known of them from elsewhere."""
        store = self._store
        store.steps[slots] = 0
        store.driven[slots] = store.free[slots] = False
        store.told[slots] = torch.nan
        store.network[slots] = torch.tensor([self._network_of(name) for name in names])
        if self.policy.base is not None:
            store.base[slots] = self.policy.base[store.network[slots]].to(store.base)
        store.driver_features[slots] = torch.nan
        for slot, name in zip(slots.tolist(), names, strict=True):
            if name in self._bases:
                store.base[slot] = torch.tensor(self._bases[name], dtype=torch.float64)
            if name in self._driver_features:
                features = torch.tensor(self._driver_features[name], dtype=torch.float64)
                store.driver_features[slot] = features

    def _begin_free(self, slots: Tensor, names: list[str], now: float, clock: Clock) -> None:
        """Begins vehicles that have no leader any more, or have just come."""
        store = self._store
        index = (~(self._goes_on(slots, now, clock) & store.free[slots])).nonzero().flatten()
        store.time[slots] = now
        if len(index) == 0:
            return
        new, beginning = slots[index], [names[number] for number in index.tolist()]
        for name in beginning:
            self._leaders.pop(name, None)
        self._begin(new, beginning)
        store.free[new] = True
        base = None if self.policy.base is None else store.base[new]
        store.parameters[new] = self.policy.free_road_parameters(store.network[new], base)

    def _begun(self, slots: Tensor) -> AgentState:
        """Returns the state of vehicles before their first window."""
        store = self._store
        base = None if self.policy.base is None else store.base[slots]
        context = DriverContext(base, store.driver_features[slots])
        return self.policy.begin(store.network[slots], context)

    def _take_over(
        self, connection: Connection, names: list[str], slots: Tensor, seen: Seen, clock: Clock
    ) -> None:
        """Drives from here on the vehicles that begin, with a new window and memory."""
        store = self._store
        for index in (~store.driven[slots]).nonzero().flatten().tolist():
            name, slot = names[index], int(slots[index])
            acts = connection.vehicle.getActionStepLength(name)
            if acts > clock.dt + 1e-6:
                raise SumoError(
                    f"vehicle '{name}' acts every {acts:g} s (actionStepLength) in steps of"
                    f" {clock.dt:g} s, and a driver acts in each; leave actionStepLength out of its"
                    f" vType, or start SUMO with --step-length {acts:g}"
                )
            store.driven[slot] = True
            store.steps[slot] = 0
            store.memory[slot] = self._driven.initial_memory(seen.speed[index])
            self._control.take(connection, name)

    def _choose(self, following: Tensor, names: list[str], due: Tensor, now: float) -> None:
        """Lets the policy choose the parameters of those followers whose window begins."""
        rows, seed = due.nonzero().flatten(), None
        if self.policy.is_stochastic:
            seed = self._seed
        for block in rows.tensor_split(max(1, -(-len(rows) // _BLOCK))):
            noise = None
            if seed is not None:
                drawn = [names[row] for row in block.tolist()]
                noise = standard_normal(seed, drawn, now, self.policy.head.noise_width)
            self._choose_together(following[block], noise)

    def _choose_together(self, slots: Tensor, noise: Tensor | None) -> None:
        """Lets the networks answer for vehicles at once."""
        if len(slots) == 0:
            return
        store = self._store
        history, state = self._known(slots)
        chosen, after = self.policy.act(history, state, noise=noise)
        store.parameters[slots] = chosen
        store.score[slots], store.beyond[slots] = after.score, after.beyond
        store.latent[slots] = after.latent
        store.state[slots] = after.state[after.network, after.place]

    def _observe(self, slots: Tensor) -> None:
        """Lets the policy see windows of vehicles that somebody else drives."""
        if len(slots) == 0:
            return
        history, state = self._known(slots)
        after = self.policy.observe(history, state, torch.ones(len(slots), dtype=torch.bool))
        self._store.state[slots] = after.state[after.network, after.place]

    def _known(self, slots: Tensor) -> tuple[History, AgentState]:
        """Returns the last frames of vehicles, and where the policy stands with them."""
        store = self._store
        begun, known = self._begun(slots), store.state[slots]
        if len(self.policy.names) == 1:
            state = known[None]
        else:
            state = begun.state.clone()
            state[begun.network, begun.place] = known
        now = begun._replace(state=state, latent=store.latent[slots])
        return History(*store.history[slots].unbind(1)), now

    def _speeds(
        self, connection: Connection, names: list[str], slots: Tensor, seen: Seen, dt: float
    ) -> tuple[Tensor, Tensor]:
        """Takes a step of the model.

        Returns:
            The next speeds `(D,)`, within the limits that SUMO puts around them; and how hard
            vehicles must be able to brake for them, m/s2, 0 where comfortably is enough.
        """
        store = self._store
        follower = Follower(
            torch.zeros_like(seen.speed), seen.speed, seen.acceleration, store.memory[slots]
        )
        zero = torch.zeros_like(seen.gap)
        leader = Leader(seen.gap, seen.leader_speed, seen.leader_acceleration, zero)
        p = self.policy.space.unpack(store.parameters[slots])
        after = advance_vehicle(self._driven, follower, leader, p, dt)
        store.memory[slots] = after.memory
        speed, bound = after.speed, torch.zeros_like(seen.speed)
        limits = self.model.limits
        if limits is not None and self.speed_mode & _BOUNDS_BRAKING:
            hardest = hardest_braking(seen, limits)
            beyond = hardest > limits.comfortable_deceleration
            for index in beyond.nonzero().flatten().tolist():
                emergency = connection.vehicle.getEmergencyDecel(names[index])
                hardest[index] = min(float(hardest[index]), emergency)
            speed = torch.maximum(speed, (seen.speed - hardest * dt).clamp(min=0.0))
            bound = torch.where(hardest > limits.comfortable_deceleration, hardest, 0.0)
        limit = seen.allowed.clone()
        # For a limit no vehicle brakes harder than its `decel`.
        for index in (seen.speed > seen.allowed).nonzero().flatten().tolist():
            slowest = seen.speed[index] - connection.vehicle.getDecel(names[index]) * dt
            limit[index] = max(limit[index], slowest)
        return torch.minimum(speed, limit), bound


def _load_policy(run: str | Path) -> Agent:
    """Reads the policy of a run.

    Raises:
        DataError: there is none, or the installed driving model has other parameters than it was
            trained for.
    """
    folder = folder_of(run)
    if not (folder / "policy.json").is_file():
        folder /= "policy"
    policy = load_checkpoint(folder)
    written = parse_json((folder / "policy.json").read_text(encoding="utf-8"))
    trained = written.get("parameters", [])
    if tuple(trained) != policy.space.names:
        raise DataError(
            f"the policy of {run} was trained for a model with the parameters {', '.join(trained)},"
            f" but model={policy.model_node['name']} here has {', '.join(policy.space.names)};"
            " train it again"
        )
    return policy
