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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, Unpack, cast

import torch
from torch import Tensor

from cfx import DrivingModel, Follower, Leader
from cfx.calibration.settings import WindowSettings
from cfx.core.errors import DataError, ParameterError, SumoError
from cfx.core.job_folder import parse_json
from cfx.core.registry import create
from cfx.core.threads import one_thread
from cfx.models.limits import at_limits
from cfx.policies.agent import Agent, AgentState
from cfx.policies.base import ConstantNetwork
from cfx.policies.checkpoint import load as load_checkpoint
from cfx.policies.context import DriverContext
from cfx.policies.core import AgentCore
from cfx.policies.features import History, Scaler
from cfx.policies.fixed import FixedPolicy
from cfx.policies.heads.direct import DirectHead
from cfx.policies.placement import ALL
from cfx.policies.valid_range import share_in_words
from cfx.results.store import folder_of
from cfx.simulation.step import advance_vehicle
from cfx_sumo.live.draws import standard_normal
from cfx_sumo.live.saved import DriverRecord, read_state, write_state
from cfx_sumo.live.surroundings import Connection, Seen, look
from cfx_sumo.live.vehicles import VehicleTable

_BOUNDS_BRAKING = 4
"""Bit of SUMO's speed mode with which a vehicle brakes no harder than its `decel`."""

_MARGIN = 1.5
"""How much harder than needed a vehicle may brake: it cannot know what its leader does next."""

_WALKING_MPS = 1.5
"""Speed below which a time gap means nothing."""

_NEAR_M = 0.2
"""Room to brake in counts as this at least, m."""

OBEYS_ALL = 31
"""Speed mode with all of SUMO's checks: lights, stops, yielding, its safe gap."""


class DriverOptions(TypedDict, total=False):
    """How vehicles are driven, whoever drives them.

    Attributes:
        look_ahead: m; a vehicle farther ahead (bumper to bumper) is no leader.
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
        steps: vehicle steps that the model drove.
        outside: those of them that began outside what the policy has learned from.
        limited: those at a limit of acceleration.
        beyond: in how many each signal alone was too low, then too high; None before the first.
    """

    steps: int = 0
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


def needed_deceleration(seen: Seen) -> Tensor:
    """Returns how hard vehicles must brake at least to keep their `minGap` behind their leaders.

    The leader goes on as it is, or brakes on to a standstill: the harder of both counts. With the
    room s, which is the gap less `minGap` (for SUMO a shorter gap is a collision, and where its own
    models end), the speeds v and v_l and the leader's deceleration b_l,

        b = (v - v_l)^2 / (2 s)  if v > v_l        b = v^2 / (2 (s + v_l^2 / (2 b_l)))

    Returns:
        `(D,)`, m/s2, not negative.
    """
    room = (seen.gap - seen.min_gap).clamp(min=_NEAR_M)
    closing = (seen.speed - seen.leader_speed).clamp(min=0.0)
    steady = closing.square() / (2.0 * room)
    braking = (-seen.leader_acceleration).clamp(min=0.0)
    path = seen.leader_speed.square() / (2.0 * braking.clamp(min=1e-3))
    stopping = torch.where(braking > 0, seen.speed.square() / (2.0 * (room + path)), 0.0)
    return torch.maximum(steady, stopping)


def _is_limited(model: DrivingModel, before: Tensor, after: Tensor, dt: float) -> Tensor:
    """Says which vehicles are at a limit of acceleration, bool `(D,)`, of speeds in m/s."""
    return at_limits(model.limits, torch.stack([before, after], -1), dt)[:, 1]


class Driver:
    """Drives any number of vehicles with the policy of one job.

        driver = Driver.load("outputs/my-job")
        connection.simulationStep()
        driver.step(connection, vehicle_ids)

    Life cycle of a vehicle: it is driven from the first `step` that names it and finds a leader.
    The policy sees the last L frames of that vehicle and of its leader, the first frame standing
    for those before, and chooses parameters every `windows.stride` steps *of that vehicle*.
    Vehicles whose window begins are one batch. That is the closed loop in which cfx evaluates a
    policy, to the last bits. A vehicle that was not stepped one time step ago, or had no leader,
    begins anew.

    Without a leader within `look_ahead`, SUMO's own model drives the vehicle (the vType's
    `carFollowModel`, to the lane's limit), since a car-following policy has never seen a free road.
    After a change of leader the vehicle goes on: the policy sees the new leader from then on.

    The lane's limit and the vehicle's `maxSpeed` hold as they do around SUMO's own models. With the
    default `speed_mode` 31 SUMO's checks bound each speed: red lights, stops, who yields at
    junctions, and SUMO's own safe gap. With `speed_mode=0` nothing else of SUMO's changes the
    speed: what the model says is driven to the last bits, so vehicles behind a leader run red
    lights, pass their stops and do not yield. That is meant for replays of recordings and roads
    without junctions. Lane changes are SUMO's.

    The model's limits of acceleration hold always (`model.limits`). Where SUMO bounds braking too
    (bit 4 of the speed mode), a vehicle brakes comfortably at most, unless keeping its
    vType's `minGap` needs more: see `needed_deceleration`. SUMO's `decel` of the vehicle is raised
    to that meanwhile.

    A driver holds the state of one simulation. Where time goes back, all its vehicles begin anew;
    several simulations at once need a driver each.
    """

    def __init__(
        self,
        policy: Agent,
        *,
        network: str | None = ALL,
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
        self.speed_mode = speed_mode
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
        self._speed_modes: dict[str, int] = {}
        self._raised: dict[str, tuple[str, float]] = {}
        self.counts = DriveCounts()
        self._leaders: dict[str, str] = {}
        self._slots: dict[str, int] = {}
        self._free: list[int] = []
        self._store = VehicleTable.empty(policy, self._driven, 0)
        self._swept = math.nan
        self._now = -math.inf

    @classmethod
    def load(
        cls,
        run: str | Path,
        *,
        network: str | None = ALL,
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
            dt: time step of the simulation, s.
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
            names=(ALL,),
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

    def drives(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now; a watched vehicle is not driven."""
        return vehicle in self._speed_modes

    def outside_in_words(self) -> str:
        """Returns how much was driven outside what the policy has learned, in words; or ""."""
        valid_range, counts = self.policy.valid_range, self.counts
        if valid_range is None or counts.beyond is None:
            return ""
        return share_in_words(valid_range, counts.outside, counts.steps, counts.beyond)

    def time_gaps(self, vehicles: Iterable[str]) -> Tensor:
        """Returns the time gaps of those that the model drives faster than walking, `(d,)`, s."""
        slots = [self._slots[name] for name in vehicles if self.drives(name)]
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
            SumoError: a vehicle is not in the simulation, or the simulation's step is not the
                policy's.
        """
        names = [vehicles] if isinstance(vehicles, str) else list(vehicles)
        now = connection.simulation.getTime()
        self._check_step(connection)
        if now < self._now:
            self._forget_all()
        self._now = now
        self._forget_departed(connection, now)
        self._forget_gone(connection, names, now)
        following, leaders, seen, alone = look(
            connection, self._not_yet(names, now), self.look_ahead
        )
        self._leaders.update(zip(following, leaders, strict=True))
        for name in alone:
            self.release(connection, name)
        if not following:
            return
        slots = torch.tensor([self._slot(name) for name in following])
        self._remember(slots, following, seen, now)
        if drive:
            self._take_over(connection, following, slots)
        store = self._store
        due = store.steps[slots] % self.policy.windows.stride == 0
        if drive:
            beginning = [following[index] for index in due.nonzero().flatten().tolist()]
            self._choose(slots[due], beginning, now)
        else:
            self._observe(slots[due])
        store.steps[slots] += 1
        if drive:
            self.counts.add(store.score[slots], store.beyond[slots])
            speeds = self._speeds(connection, following, slots, seen).tolist()
            for name, speed in zip(following, speeds, strict=True):
                connection.vehicle.setSpeed(name, speed)
            store.told[slots] = torch.tensor(speeds, dtype=torch.float64)

    def _not_yet(self, names: list[str], now: float) -> list[str]:
        """Returns the vehicles that were not stepped at this instant before."""
        times = self._store.time.tolist()
        wanted = []
        for name in names:
            slot = self._slots.get(name)
            if slot is None or times[slot] != now:
                wanted.append(name)
        return wanted

    def save_state(self, path: str | Path) -> None:
        """Writes what is known of all vehicles, for a simulation that goes on from here.

        SUMO's own state of the same instant (`simulation.saveState`) belongs to it; SUMO writes it
        exactly with `--save-state.precision 17`.

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
            "speed_modes": self._speed_modes,
            "raised": self._raised,
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
        slots = torch.tensor([self._slot(name) for name in names], dtype=torch.int64)
        self._store.put_columns(slots, rows)
        self._leaders = dict(described["leaders"])
        self._speed_modes = dict(described["speed_modes"])
        self._raised = {name: (kind, own) for name, (kind, own) in described["raised"].items()}
        self._assigned = dict(described["assigned"])
        self._bases = dict(described["bases"])
        self._driver_features = dict(described["driver_features"])
        told = self._store.told.tolist()
        for name in self._speed_modes:  # SUMO's state keeps nothing of TraCI's
            connection.vehicle.setSpeedMode(name, self.speed_mode)
            connection.vehicle.setSpeed(name, told[self._slots[name]])

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
        self._speed_modes.pop(vehicle, None)
        self._leaders.pop(vehicle, None)
        self._raised.pop(vehicle, None)
        slot = self._slots.pop(vehicle, None)
        if slot is not None:
            self._free.append(slot)

    def _forget_all(self) -> None:
        """Drops all vehicles: time went back, so this is another simulation or an earlier state."""
        for vehicle in self.vehicles:
            self.forget(vehicle)
        self._swept = math.nan

    def release(self, connection: Connection, vehicle: str) -> None:
        """Hands a vehicle back to SUMO's own model and drops what is known of it."""
        if vehicle in self._speed_modes:
            connection.vehicle.setSpeed(vehicle, -1)
            connection.vehicle.setSpeedMode(vehicle, self._speed_modes[vehicle])
            self._set_decel(connection, vehicle, 0.0)
        self.forget(vehicle)

    def _number(self, network: str) -> int:
        names = self.policy.names
        if network in names:
            return names.index(network)
        if network == ALL and len(names) == 1:
            return 0
        if network == ALL:
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

    def _check_step(self, connection: Connection) -> None:
        dt = connection.simulation.getDeltaT()
        if abs(dt - self.policy.dt) > 1e-6:
            raise SumoError(
                f"the simulation steps by {dt:g} s, the policy of {self.source} was trained at"
                f" {self.policy.dt:g} s; start SUMO with --step-length {self.policy.dt:g}"
            )

    def _forget_departed(self, connection: Connection, now: float) -> None:
        """Drops vehicles that have just departed: another vehicle had that id a step ago."""
        for name in connection.simulation.getDepartedIDList():
            slot = self._slots.get(name)
            if slot is not None and float(self._store.time[slot]) != now:
                self.forget(name)

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

    def _slot(self, name: str) -> int:
        """Returns the row of a vehicle; a new vehicle gets one."""
        if name not in self._slots:
            if not self._free:
                taken = len(self._slots)
                more = VehicleTable.empty(self.policy, self._driven, max(16, taken))
                self._store = self._store.with_rows(more)
                self._free = list(range(taken, len(self._store.time)))
            self._slots[name] = slot = self._free.pop()
            self._store.time[slot] = torch.nan  # it has no frame yet
        return self._slots[name]

    def _remember(self, slots: Tensor, names: list[str], seen: Seen, now: float) -> None:
        """Puts this instant into the vehicles' histories; begins vehicles that are new."""
        store, dt = self._store, self.policy.dt
        history = History(
            seen.leader_speed,
            seen.leader_acceleration,
            seen.speed,
            seen.acceleration,
            seen.gap,
        )
        frame = torch.stack(list(history), 1)
        going = (now - store.time[slots] - dt).abs() < 0.5 * dt
        earlier = store.history[slots[going], :, 1:]
        store.history[slots[going]] = torch.cat([earlier, frame[going, :, None]], -1)
        store.time[slots] = now
        if not bool(going.all()):
            index = (~going).nonzero().flatten()
            new = [names[number] for number in index.tolist()]
            self._begin(slots[index], new, frame[index])

    def _begin(self, slots: Tensor, names: list[str], frame: Tensor) -> None:
        """Begins vehicles anew: the first frame `(D, 5)` stands for those before it."""
        store = self._store
        store.history[slots] = frame[:, :, None]
        store.steps[slots] = 0
        store.driven[slots] = False
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
        begun = self._begun(slots)
        store.state[slots] = begun.state[begun.network, begun.place]
        store.latent[slots] = begun.latent

    def _begun(self, slots: Tensor) -> AgentState:
        """Returns the state of vehicles before their first window."""
        store = self._store
        base = None if self.policy.base is None else store.base[slots]
        context = DriverContext(base, store.driver_features[slots])
        return self.policy.begin(store.network[slots], context)

    def _take_over(self, connection: Connection, names: list[str], slots: Tensor) -> None:
        """Drives from here on the vehicles that were only watched, with a new window and memory."""
        store = self._store
        speed = History._fields.index("follower_speed")
        for index in (~store.driven[slots]).nonzero().flatten().tolist():
            name, slot = names[index], int(slots[index])
            store.driven[slot] = True
            store.steps[slot] = 0
            store.memory[slot] = self._driven.initial_memory(store.history[slot, speed, -1])
            self._speed_modes.setdefault(name, connection.vehicle.getSpeedMode(name))
            connection.vehicle.setSpeedMode(name, self.speed_mode)

    def _choose(self, slots: Tensor, names: list[str], now: float) -> None:
        """Lets the policy choose the parameters of vehicles whose window begins."""
        if len(slots) == 0:
            return
        store = self._store
        chosen, after = self.policy.act(*self._known(slots))
        if self._seed is not None and self.policy.is_stochastic:
            noise = standard_normal(self._seed, names, now, self.policy.head.noise_width)
            chosen, after = self._drawn(chosen, after, noise)
        store.parameters[slots] = chosen
        store.score[slots], store.beyond[slots] = after.score, after.beyond
        store.latent[slots] = after.latent
        store.state[slots] = after.state[after.network, after.place]

    def _drawn(self, chosen: Tensor, state: AgentState, noise: Tensor) -> tuple[Tensor, AgentState]:
        """Draws parameters `(D, n)` around those that were chosen, from noise `(D, k)`."""
        policy = self.policy
        if policy.dispersion is not None:
            noise = noise * policy.dispersion[state.network, None].to(noise)
        window_s = policy.windows.stride * policy.dt
        drawn, latent = policy.head.sampled(chosen, noise, state.latent.to(chosen), window_s)
        return drawn, state._replace(latent=latent.to(state.latent))

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
        begun = self._begun(slots)
        state = begun.state.clone()
        state[begun.network, begun.place] = store.state[slots]
        now = begun._replace(state=state, latent=store.latent[slots])
        return History(*store.history[slots].unbind(1)), now

    def _speeds(
        self, connection: Connection, names: list[str], slots: Tensor, seen: Seen
    ) -> Tensor:
        """Returns the model's next speeds `(D,)`, within the limits that SUMO puts around it."""
        store, dt = self._store, self.policy.dt
        follower = Follower(
            torch.zeros_like(seen.speed), seen.speed, seen.acceleration, store.memory[slots]
        )
        leader = Leader(
            seen.gap + seen.leader_length,
            seen.leader_speed,
            seen.leader_acceleration,
            seen.leader_length,
        )
        p = self.policy.space.unpack(store.parameters[slots])
        after = advance_vehicle(self._driven, follower, leader, p, dt)
        store.memory[slots] = after.memory
        speed = after.speed
        limits = self.model.limits
        if limits is not None and self.speed_mode & _BOUNDS_BRAKING:
            needed = _MARGIN * needed_deceleration(seen)
            hardest = needed.clamp(limits.comfortable_deceleration, limits.emergency_deceleration)
            speed = torch.maximum(speed, (seen.speed - hardest * dt).clamp(min=0.0))
            is_needed = hardest > limits.comfortable_deceleration
            bounds = torch.where(is_needed, hardest, 0.0).tolist()
            for name, bound in zip(names, bounds, strict=True):
                self._set_decel(connection, name, bound)
        self.counts.limited += int(_is_limited(self.model, seen.speed, speed, dt).sum())
        limit = seen.allowed.clone()
        # For a limit no vehicle brakes harder than its `decel`.
        for index in (seen.speed > seen.allowed).nonzero().flatten().tolist():
            slowest = seen.speed[index] - connection.vehicle.getDecel(names[index]) * dt
            limit[index] = max(limit[index], slowest)
        return torch.minimum(speed, limit)

    def _set_decel(self, connection: Connection, name: str, bound: float) -> None:
        """Lets SUMO brake a vehicle by `bound`, m/s2, where that is more than its own `decel`.

        SUMO makes a vType for this vehicle then; it has its own one again as soon as it can.
        """
        if bound == 0.0 and name not in self._raised:
            return
        vehicle = connection.vehicle
        kind, own = self._raised.get(name) or (vehicle.getTypeID(name), vehicle.getDecel(name))
        if bound > own:
            vehicle.setDecel(name, bound)
            self._raised[name] = kind, own
        elif name in self._raised:
            del self._raised[name]
            if vehicle.getTypeID(name) == kind:
                vehicle.setDecel(name, own)  # it had a vType of its own before
            else:
                vehicle.setType(name, kind)


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
