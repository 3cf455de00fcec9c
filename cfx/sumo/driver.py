"""Live drivers: a trained policy drives vehicles of somebody else's SUMO simulation, through TraCI or libsumo.

W99's parameters cannot be changed in SUMO while a vehicle drives. So cfx computes each vehicle's next speed with its own model,
which is SUMO's model, and tells SUMO that speed: what SUMO then drives is exact. All vehicles of a step are one batch, through
one call of the policy and one call of the model.

Shapes: D vehicles, n tuned parameters, m width of the model's memory, s width of the policy's state, L frames of a token.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from cfx import registry
from cfx.agents import checkpoint
from cfx.agents.agent import Agent, AgentState
from cfx.agents.context import DriverContext
from cfx.agents.core import AgentCore
from cfx.agents.heads.direct import DirectHead
from cfx.agents.placement import ALL
from cfx.agents.scaler import Scaler
from cfx.calibration.settings import WindowSettings
from cfx.errors import DataError, ParameterError, SumoError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.base import ConstantNetwork
from cfx.policies.features import History
from cfx.policies.fixed import FixedPolicy
from cfx.simulation.step import advance_vehicle
from cfx.simulation.threads import one_thread
from cfx.tracking.store import folder_of

Connection = Any
"""The module `libsumo`, the module `traci`, or a connection that `traci.getConnection` gives."""


class Seen(NamedTuple):
    """What D vehicles and their leaders do at one instant; `(D,)` each, SI units.

    Attributes:
        speed, acceleration: the follower's.
        gap: bumper to bumper.
        leader_speed, leader_acceleration, leader_length: of the vehicle ahead.
        allowed: the speed limit that holds for the follower.
    """

    speed: Tensor
    acceleration: Tensor
    gap: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    leader_length: Tensor
    allowed: Tensor


class Driver:
    """Drives any number of vehicles with the policy of one job.

        driver = Driver.load("outputs/my-job")
        connection.simulationStep()
        driver.step(connection, vehicle_ids)

    Life cycle of a vehicle: it is driven from the first `step` that names it and finds a leader. The policy sees the last L
    frames of that vehicle and whoever was ahead of it, the first frame standing for those before, and chooses parameters every
    `windows.stride` steps *of that vehicle*; vehicles whose turn it is are one batch. That is the closed loop in which cfx
    evaluates a policy, to the last bits. A vehicle that was not stepped one time step ago, or had no leader, begins anew.

    No leader within `look_ahead`: SUMO's own model drives the vehicle (the vType's `carFollowModel`, to the lane's limit), since
    a car-following policy has never seen a free road. A change of leader begins nothing: the policy sees the new one from then.

    The lane's limit and the vehicle's `maxSpeed` hold as they do around SUMO's own models. With the default `speed_mode` 0
    nothing else of SUMO's changes the speed, so junctions, red lights and stops are not obeyed behind a leader: exact, and meant
    for motorways. `speed_mode=31` lets SUMO's checks bound the speed, its own safe gap among them. Lane changes are SUMO's.

    A driver holds the state of one simulation; use another for another.
    """

    def __init__(
        self,
        policy: Agent,
        *,
        network: str | None = ALL,
        look_ahead: float = 200.0,
        speed_mode: int = 0,
        model: DrivingModel | None = None,
        source: str = "this policy",
    ) -> None:
        """Makes a driver.

        Args:
            policy: chooses parameters.
            network: which of its networks drives vehicles that `assign` does not name; None: `assign` must name each.
            look_ahead: m; a vehicle farther ahead (bumper to bumper) is no leader.
            speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven.
            model: the driving model; None for the one that the policy was trained for.
            source: where the policy comes from, for messages.

        Raises:
            DataError: the policy has no such network, or its driving model has no equations but in SUMO.
        """
        self.policy = policy
        self.look_ahead = look_ahead
        self.speed_mode = speed_mode
        self.source = source
        self.model = model or cast(DrivingModel, registry.create("model", policy.model_node))
        if self.model.needs_simulator:
            raise DataError(
                f"{source} chooses parameters of model={policy.model_node['name']}, which SUMO alone drives: nobody can change"
                " them on the way; a live driver needs a model that cfx has, such as krauss or w99"
            )
        self._network = None if network is None else self._number(network)
        self._assigned: dict[str, int] = {}
        self._bases: dict[str, list[float]] = {}
        self._driver_features: dict[str, list[float]] = {}
        self._speed_modes: dict[str, int] = {}
        self._slots: dict[str, int] = {}
        self._free: list[int] = []
        self._store = _Store.of(policy, self.model, 0)
        self._swept = math.nan

    @classmethod
    def load(
        cls,
        run: str | Path,
        *,
        network: str | None = ALL,
        model: str | None = None,
        look_ahead: float = 200.0,
        speed_mode: int = 0,
    ) -> Driver:
        """Reads a job's policy.

        Args:
            run: a job's output folder (or its `policy` folder), or the id of its MLflow run.
            network: which of the policy's networks drives: `all`, which drives anybody, or the id of a pair, to drive like him.
            model: refuse a policy of another driving model than this.
            look_ahead: m; a vehicle farther ahead is no leader.
            speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven.

        Raises:
            DataError: there is no such policy, it has no such network, or it is one of another model.
        """
        policy = _trained(run)
        name = policy.model_node["name"]
        if model is not None and name != model:
            raise DataError(
                f"{run} was trained for model={name}, not for model={model}; name a run with model={model}"
            )
        return cls(
            policy, network=network, look_ahead=look_ahead, speed_mode=speed_mode, source=str(run)
        )

    @classmethod
    def constant(
        cls,
        model: DrivingModel,
        parameters: Mapping[str, float] | None = None,
        *,
        dt: float = 0.1,
        look_ahead: float = 200.0,
        speed_mode: int = 0,
    ) -> Driver:
        """Makes a driver who keeps the same parameters: what a policy is compared with.

        Args:
            model: the driving model.
            parameters: name -> value, SI units; the others at their defaults.
            dt: time step of the simulation, s.
            look_ahead: m; a vehicle farther ahead is no leader.
            speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven.

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
        return cls(
            policy,
            look_ahead=look_ahead,
            speed_mode=speed_mode,
            model=model,
            source="the constant driver",
        )

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
            base: a driver's own parameters, name -> SI value, that a policy of offsets (`learner=rollout`) starts from, drawn
                towards the default as in training; None: what it has for unseen drivers. Policies that answer parameters themselves
                have no use for it.
            driver features: a driver's driver features, name -> value, where the policy was trained to know some (`policy.driver_features`;
                `Agent.traits_of` measures them); None: those of an unseen driver. What a vehicle does while it is watched
                changes nothing of them.

        Raises:
            DataError: the policy has no such network.
            ParameterError: `base` is not a value for each tuned parameter, or `driver features` not one for each driver feature of the policy.
        """
        if network is not None:
            self._assigned[vehicle] = self._number(network)
        if base is not None:
            if set(base) != set(self.policy.space.names):
                raise ParameterError(
                    f"base: give a value for each of {', '.join(self.policy.space.names)}, and nothing else"
                )
            own = torch.tensor(
                [[base[name] for name in self.policy.space.names]], dtype=torch.float64
            )
            self._bases[vehicle] = self.policy.base_of(own)[0].tolist()
        if driver_features is not None:
            known = self.policy.policy.driver_features
            if not known:
                raise ParameterError(
                    "driver features: there are none that this policy was trained to know; leave them out"
                )
            if set(driver_features) != set(known):
                raise ParameterError(
                    f"driver features: give a value for each of {', '.join(known)}, and nothing else"
                )
            self._driver_features[vehicle] = [driver_features[name] for name in known]

    def renew(self, vehicle: str) -> None:
        """Lets the policy's memory of a vehicle begin anew; the frames of its last window stay."""
        slot = self._slots.get(vehicle)
        if slot is not None:
            begun = self._begun(torch.tensor([slot]))
            self._store.state[slot] = begun.state[begun.network, begun.place][0]

    def drives(self, vehicle: str) -> bool:
        """Says whether the model drives a vehicle now; it does not where nobody is ahead, or the vehicle is only watched."""
        return vehicle in self._speed_modes

    def parameters(self, vehicle: str) -> dict[str, float]:
        """Returns the parameters with which a vehicle drives now, SI units; empty if no leader is ahead of it."""
        slot = self._slots.get(vehicle)
        return (
            {}
            if slot is None
            else dict(
                zip(self.policy.space.names, self._store.parameters[slot].tolist(), strict=True)
            )
        )

    @torch.no_grad()
    @one_thread()
    def step(
        self, connection: Connection, vehicles: str | Iterable[str], *, drive: bool = True
    ) -> None:
        """Sets the speeds that vehicles will drive in the next `simulationStep`; call it after each.

        Args:
            connection: `libsumo`, `traci` or one of its connections.
            vehicles: one id or many.
            drive: False only watches, so that the policy knows the history of a vehicle when it takes over from somebody else.

        Raises:
            SumoError: a vehicle is not in the simulation, or the simulation's step is not the policy's.
        """
        names = [vehicles] if isinstance(vehicles, str) else list(vehicles)
        now = connection.simulation.getTime()
        self._check_step(connection)
        self._forget_gone(connection, names, now)
        times = self._store.time.tolist()
        names = [
            name for name in names if name not in self._slots or times[self._slots[name]] != now
        ]  # once an instant
        following, seen = self._look(connection, names)
        if not following:
            return
        slots = torch.tensor([self._slot(name) for name in following])
        store = self._store
        for index in (
            self._remember(slots, following, seen, now, drive=drive).nonzero().flatten().tolist()
        ):
            self._take_over(connection, following[index], int(slots[index]))
        self._choose(slots[store.steps[slots] % self.policy.windows.stride == 0])
        store.steps[slots] += 1
        if drive:
            for name, speed in zip(
                following, self._speeds(connection, following, slots, seen).tolist(), strict=True
            ):
                connection.vehicle.setSpeed(name, speed)

    def forget(self, vehicle: str) -> None:
        """Drops all that is known of a vehicle; SUMO keeps the last speed that it was told."""
        self._speed_modes.pop(vehicle, None)
        slot = self._slots.pop(vehicle, None)
        if slot is not None:
            self._free.append(slot)

    def release(self, connection: Connection, vehicle: str) -> None:
        """Hands a vehicle back to SUMO's own model and drops what is known of it."""
        if vehicle in self._speed_modes:
            connection.vehicle.setSpeed(vehicle, -1)
            connection.vehicle.setSpeedMode(vehicle, self._speed_modes[vehicle])
        self.forget(vehicle)

    def _number(self, network: str) -> int:
        names = self.policy.names
        if network in names:
            return names.index(network)
        if network == ALL and len(names) == 1:
            return 0
        if network == ALL:
            raise DataError(
                f"{self.source} has {len(names)} networks, each for one driver ({names[0]}, ...), and none for unseen drivers; train"
                " with protocol.networks=all or protocol=across_drivers, or name one of them: Driver.load(..., network=...)"
            )
        raise DataError(
            f"{self.source} has no network '{network}'; it has {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"
        )

    def _drives(self, vehicle: str) -> int:
        """Returns the number of the network that drives a vehicle."""
        number = self._assigned.get(vehicle, self._network)
        if number is None:
            raise DataError(
                f"no network of {self.source} was assigned to vehicle '{vehicle}'; call assign(vehicle, network) first"
            )
        return number

    def _check_step(self, connection: Connection) -> None:
        dt = connection.simulation.getDeltaT()
        if abs(dt - self.policy.dt) > 1e-6:
            raise SumoError(
                f"the simulation steps by {dt:g} s, the policy of {self.source} was trained at {self.policy.dt:g} s; start SUMO"
                f" with --step-length {self.policy.dt:g}"
            )

    def _forget_gone(self, connection: Connection, names: list[str], now: float) -> None:
        """Drops vehicles that have left, once an instant and only if those that are asked for leave some unaccounted for."""
        if self._swept != now and not self._slots.keys() <= set(names):
            self._swept = now
            for gone in self._slots.keys() - set(connection.vehicle.getIDList()):
                self.forget(gone)
                self._assigned.pop(gone, None)
                self._bases.pop(gone, None)
                self._driver_features.pop(gone, None)

    def _look(self, connection: Connection, names: list[str]) -> tuple[list[str], Seen]:
        """Reads vehicles and leaders; one without a leader goes back to SUMO."""
        vehicle = connection.vehicle
        following, rows = [], []
        motions: dict[
            str, tuple[float, float]
        ] = {}  # a follower is the next one's leader, and TraCI is slow

        def motion(one: str) -> tuple[float, float]:
            if one not in motions:
                motions[one] = vehicle.getSpeed(one), vehicle.getAcceleration(one)
            return motions[one]

        for name in names:
            leader = self._leader(connection, name)
            if leader is None:
                self.release(connection, name)
                continue
            ahead, gap = leader
            following.append(name)
            rows.append(
                (
                    *motion(name),
                    gap,
                    *motion(ahead),
                    vehicle.getLength(ahead),
                    vehicle.getAllowedSpeed(name),
                )
            )
        return following, Seen(
            *torch.tensor(rows, dtype=torch.float64).reshape(-1, len(Seen._fields)).unbind(1)
        )

    def _leader(self, connection: Connection, name: str) -> tuple[str, float] | None:
        """Returns who is ahead of a vehicle and the gap from bumper to bumper, m; None if nobody is within `look_ahead`."""
        try:
            leader = connection.vehicle.getLeader(name, self.look_ahead)
        except Exception as error:
            if (
                type(error).__name__ != "TraCIException"
            ):  # libsumo's and traci's are two classes of this name
                raise
            raise SumoError(
                f"vehicle '{name}' cannot be driven ({error}); step only vehicles of connection.vehicle.getIDList()"
            ) from error
        if not leader or not leader[0]:
            return None
        gap = leader[1] + connection.vehicle.getMinGap(name)  # SUMO's own gap leaves minGap out
        return (leader[0], gap) if gap <= self.look_ahead else None

    def _slot(self, name: str) -> int:
        """Returns where a vehicle's state stands; a new vehicle gets a place."""
        if name not in self._slots:
            if not self._free:
                taken = len(self._slots)
                self._store = self._store.grown(_Store.of(self.policy, self.model, max(16, taken)))
                self._free = list(range(taken, len(self._store.time)))
            self._slots[name] = slot = self._free.pop()
            self._store.time[slot] = torch.nan  # it has no frame yet
        return self._slots[name]

    def _remember(
        self, slots: Tensor, names: list[str], seen: Seen, now: float, *, drive: bool
    ) -> Tensor:
        """Puts this instant into the vehicles' histories and begins those that were not there one step ago.

        Returns:
            `(D,)` bool: the vehicles that are driven from now on.
        """
        store = self._store
        frame = torch.stack(
            [
                getattr(seen, name)
                for name in ("leader_speed", "leader_acceleration", "speed", "acceleration", "gap")
            ],
            1,
        )
        going = (now - store.time[slots] - self.policy.dt).abs() < 0.5 * self.policy.dt
        store.history[slots[going]] = torch.cat(
            [store.history[slots[going], :, 1:], frame[going, :, None]], -1
        )
        store.time[slots] = now
        if not bool(going.all()):
            self._begin(
                slots[~going],
                [name for name, goes in zip(names, going.tolist(), strict=True) if not goes],
                frame[~going],
            )
        return ~store.driven[slots] & drive

    def _begin(self, slots: Tensor, names: list[str], frame: Tensor) -> None:
        """Begins vehicles anew: the first frame `(D, 5)` stands for those before it."""
        store = self._store
        store.history[slots] = frame[:, :, None]
        store.steps[slots] = 0
        store.driven[slots] = False
        store.network[slots] = torch.tensor([self._drives(name) for name in names])
        if self.policy.base is not None:
            store.base[slots] = self.policy.base[store.network[slots]].to(store.base)
        store.driver_features[slots] = torch.nan
        for slot, name in zip(slots.tolist(), names, strict=True):
            for column, assigned in (
                (store.base, self._bases),
                (store.driver_features, self._driver_features),
            ):
                if name in assigned:
                    column[slot] = torch.tensor(assigned[name], dtype=column.dtype)
        begun = self._begun(slots)
        store.state[slots] = begun.state[begun.network, begun.place]

    def _begun(self, slots: Tensor) -> AgentState:
        """Returns the state of vehicles before their first window."""
        base = None if self.policy.base is None else self._store.base[slots]
        context = DriverContext(base, self._store.driver_features[slots])
        return self.policy.begin(self._store.network[slots], context)

    def _take_over(self, connection: Connection, name: str, slot: int) -> None:
        """From here on this vehicle is driven: with a new window and a new memory, however long it was watched."""
        store = self._store
        store.driven[slot] = True
        store.steps[slot] = 0
        store.memory[slot] = self.model.initial_memory(
            store.history[slot, History._fields.index("follower_speed"), -1]
        )
        self._speed_modes.setdefault(name, connection.vehicle.getSpeedMode(name))
        connection.vehicle.setSpeedMode(name, self.speed_mode)

    def _choose(self, slots: Tensor) -> None:
        """Lets the policy choose the parameters of vehicles whose window begins."""
        if not len(slots):
            return
        store = self._store
        begun = self._begun(slots)
        state = begun.state.clone()
        state[begun.network, begun.place] = store.state[slots]
        chosen, after = self.policy.act(
            History(*store.history[slots].unbind(1)), begun._replace(state=state)
        )
        store.parameters[slots] = chosen
        store.state[slots] = after.state[after.network, after.place]

    def _speeds(
        self, connection: Connection, names: list[str], slots: Tensor, seen: Seen
    ) -> Tensor:
        """Returns the next speeds `(D,)` by the model, within the limits that SUMO puts around every model."""
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
        after = advance_vehicle(self.model, follower, leader, p, dt)
        store.memory[slots] = after.memory
        limit = seen.allowed.clone()
        for index in (
            (seen.speed > seen.allowed).nonzero().flatten().tolist()
        ):  # nobody brakes harder than `decel` for a limit
            limit[index] = max(
                limit[index], seen.speed[index] - connection.vehicle.getDecel(names[index]) * dt
            )
        return torch.minimum(after.speed, limit)


@dataclass(frozen=True)
class _Store:
    """What is known of C vehicles.

    Attributes:
        history: `(C, 5, L)`, the signals of `History`.
        parameters: `(C, n)`, SI units.
        memory: `(C, m)`, the model's.
        state: `(C, s)`, the policy's.
        network: `(C,)` int64, which of the policy's networks drives.
        base: `(C, n)`, SI units, what a policy of offsets starts from.
        driver features: `(C, k)`, of the drivers; NaN for unseen drivers.
        steps: `(C,)` int64, since the vehicle's first window.
        time: `(C,)` s, of the last frame; NaN before the first.
        driven: `(C,)` bool; the others are watched.
    """

    history: Tensor
    parameters: Tensor
    memory: Tensor
    state: Tensor
    network: Tensor
    base: Tensor
    driver_features: Tensor
    steps: Tensor
    time: Tensor
    driven: Tensor

    @classmethod
    def of(cls, policy: Agent, model: DrivingModel, count: int) -> _Store:
        """Makes place for `count` vehicles."""
        state = policy.begin(torch.zeros(1, dtype=torch.int64)).state
        real = torch.float64
        return cls(
            history=torch.full(
                (count, len(History._fields), policy.windows.length), torch.nan, dtype=real
            ),
            parameters=torch.full((count, len(policy.space)), torch.nan, dtype=real),
            memory=torch.zeros((count, model.memory_size), dtype=real),
            state=state.new_zeros((count, state.shape[-1])),
            network=torch.zeros(count, dtype=torch.int64),
            base=torch.full((count, len(policy.space)), torch.nan, dtype=real),
            driver_features=torch.full(
                (count, len(policy.policy.driver_features)), torch.nan, dtype=real
            ),
            steps=torch.zeros(count, dtype=torch.int64),
            time=torch.full((count,), torch.nan, dtype=real),
            driven=torch.zeros(count, dtype=torch.bool),
        )

    def grown(self, more: _Store) -> _Store:
        """Returns both."""
        return _Store(
            **{
                one.name: torch.cat([getattr(self, one.name), getattr(more, one.name)])
                for one in fields(self)
            }
        )


def _trained(run: str | Path) -> Agent:
    """Reads the policy of a run.

    Raises:
        DataError: there is none, or the installed driving model has other parameters than it was trained for.
    """
    folder = folder_of(run)
    if not (folder / "policy.json").is_file():
        folder /= "policy"
    policy = checkpoint.load(folder)
    trained = json.loads((folder / "policy.json").read_text(encoding="utf-8"))["parameters"]
    if tuple(trained) != policy.space.names:
        raise DataError(
            f"the policy of {run} was trained for a model with the parameters {', '.join(trained)}, but"
            f" model={policy.model_node['name']} here has {', '.join(policy.space.names)}; train it again"
        )
    return policy
