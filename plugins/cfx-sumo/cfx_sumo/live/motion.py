"""Steps of the driving model in a running simulation, within the limits that SUMO puts around them.

Shapes: D vehicles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.plugin import (
    Agent,
    DrivingModel,
    Follower,
    Leader,
    LimitSettings,
    RowFunction,
    Rows,
    advance_vehicle,
    folder_hash,
    is_at_limit,
    row_function,
    step_key,
)
from cfx_sumo.live.braking import hardest_braking
from cfx_sumo.live.surroundings import Connection, Seen
from cfx_sumo.live.vehicles import KnownVehicles

_Floats = NDArray[np.float64]


_COMPUTED = ("proposed", "hardest", "speed", "is_special", "is_limited")
"""What is computed of each vehicle: the next speed that the model and the guard propose, m/s; how
hard it may brake, m/s2; its next speed, m/s, if nothing special bounds it; 1 where SUMO must be
asked how hard it can brake, as it must brake hard or is faster than the limit; 1 where it is at a
limit of acceleration."""


class ModelStep(NamedTuple):
    """Where a step of the model leads D vehicles.

    Attributes:
        speed: the next speeds, `(D,)`, m/s.
        bound: how hard vehicles must be able to brake for them, `(D,)`, m/s2, 0 where comfortably
            is enough; None: it is for all.
        is_limited: which are at a limit of acceleration, `(D,)`; 0: not.
    """

    speed: _Floats
    bound: _Floats | None
    is_limited: NDArray[Any]


class ModelSteps:
    """Takes the model's steps with the parameters in the vehicles' rows.

    Args:
        policy: whose head may drive beside the model.
        model: the driving model.
        vehicles: in whose rows parameters and the model's memory are.
        bounds_braking: whether vehicles brake no harder than comfortably unless they must.
    """

    def __init__(
        self, policy: Agent, model: DrivingModel, vehicles: KnownVehicles, *, bounds_braking: bool
    ) -> None:
        self._space = policy.space
        self._driven = policy.core.head.driven_model(model)
        self._vehicles = vehicles
        self._limits = model.limits
        self._bounded_by = model.limits if bounds_braking else None
        self._proposals: dict[float, RowFunction] = {}

    def begin(self, row: int, speed: Tensor) -> None:
        """Begins the model's memory of a vehicle that drives at `speed`, `()`, m/s."""
        self._vehicles.table.memory[row] = self._driven.initial_memory(speed)

    def take(
        self, connection: Connection, names: list[str], rows: Tensor, seen: Seen, dt: float
    ) -> ModelStep:
        """Takes a step of the model.

        Args:
            connection: to the simulation.
            names: the vehicles.
            rows: theirs, `(D,)` int64.
            seen: what they do.
            dt: the step, s.
        """
        table = self._vehicles.table
        computed = torch.empty((len(_COMPUTED), len(rows)), dtype=torch.float64)
        memory = Rows(table.memory, rows)
        inputs = [*map(Rows, seen), Rows(table.parameters, rows), memory]
        self._proposal(dt)(len(rows), inputs, [Rows(computed.T), memory])
        proposed, hardest, speed, is_special, is_limited = computed.numpy()
        if not is_special.any():
            return ModelStep(speed, None, is_limited)
        bound = None
        if self._bounded_by is not None:
            proposed, bound = _comfortable(
                connection, names, seen, proposed, hardest, self._bounded_by, dt
            )
        speed = np.minimum(proposed, _allowed(connection, names, seen, dt))
        if self._limits is not None:
            is_limited = is_at_limit(self._limits, (speed - seen.speed.numpy()) / dt)
        return ModelStep(speed, bound, is_limited)

    def behind(self, rows: Tensor, seen: Seen, dt: float) -> Tensor:
        """Returns the next speeds of vehicles behind other leaders than their own, `(D,)`, m/s.

        Nothing is kept of it: their steps are those of `take`.

        Args:
            rows: of the vehicles, `(D,)` int64.
            seen: what they and those leaders do.
            dt: the step, s.
        """
        table = self._vehicles.table
        computed = torch.empty((len(_COMPUTED), len(rows)), dtype=torch.float64)
        unkept = torch.empty((len(rows), table.memory.shape[-1]), dtype=torch.float64)
        inputs = [*map(Rows, seen), Rows(table.parameters, rows), Rows(table.memory, rows)]
        self._proposal(dt)(len(rows), inputs, [Rows(computed.T), Rows(unkept)])
        return computed[_COMPUTED.index("proposed")]

    def _proposal(self, dt: float) -> RowFunction:
        """Returns the model's step of `dt` seconds as a function of vehicles' rows.

        It takes the signals of `Seen`, parameters and the model's memory. It gives `_COMPUTED` and
        the memory afterwards.
        """
        if dt in self._proposals:
            return self._proposals[dt]
        driven, space, limits = self._driven, self._space, self._limits
        bounded_by = self._bounded_by

        def propose(*values: Tensor) -> tuple[Tensor, Tensor]:
            *signals, parameters, memory = values
            seen = Seen(*(signal[:, 0] for signal in signals))
            zero = torch.zeros_like(seen.gap)
            follower = Follower(zero, seen.speed, seen.acceleration, memory)
            leader = Leader(seen.gap, seen.leader_speed, seen.leader_acceleration, zero)
            after = advance_vehicle(driven, follower, leader, space.unpack(parameters), dt)
            speed, hardest, is_special = after.speed, zero, seen.speed > seen.allowed
            if bounded_by is not None:
                hardest = hardest_braking(seen, bounded_by)
                is_special = is_special | (hardest > bounded_by.comfortable_deceleration)
                speed = torch.maximum(speed, (seen.speed - hardest * dt).clamp(min=0.0))
            speed = torch.minimum(speed, seen.allowed)
            is_limited = torch.zeros_like(is_special)
            if limits is not None:
                is_limited = is_at_limit(limits, (speed - seen.speed) / dt)
            flags = is_special.to(zero.dtype), is_limited.to(zero.dtype)
            return torch.stack([after.speed, hardest, speed, *flags], -1), after.memory

        key = step_key(driven)
        if key is not None:
            bounds = [
                None if bound is None else bound.model_dump() for bound in (limits, bounded_by)
            ]
            key = [key, [repr(parameter) for parameter in space], bounds, dt, folder_hash(__file__)]
        widths = [1] * len(Seen._fields) + [len(space), driven.memory_size]
        self._proposals[dt] = row_function(propose, widths, key)
        return self._proposals[dt]


def _comfortable(
    connection: Connection,
    names: list[str],
    seen: Seen,
    speed: _Floats,
    hardest: _Floats,
    limits: LimitSettings,
    dt: float,
) -> tuple[_Floats, _Floats]:
    """Raises speeds `(D,)` so that vehicles brake comfortably, unless their `minGap` needs more.

    Args:
        connection: to the simulation.
        names: the vehicles.
        seen: what they do.
        speed: proposed, `(D,)`, m/s.
        hardest: how hard they may brake now, `(D,)`, m/s2; bounded by their `emergencyDecel`.
        limits: of the model.
        dt: the step, s.

    Returns:
        The speeds `(D,)`, m/s; and how hard vehicles must be able to brake, `(D,)`, m/s2, 0 where
        comfortably is enough.
    """
    comfortable = limits.comfortable_deceleration
    for index in np.flatnonzero(hardest > comfortable).tolist():
        emergency = connection.vehicle.getEmergencyDecel(names[index])
        hardest[index] = min(float(hardest[index]), emergency)
    slowest = np.maximum(seen.speed.numpy() - hardest * dt, 0.0)
    return np.maximum(speed, slowest), np.where(hardest > comfortable, hardest, 0.0)


def _allowed(connection: Connection, names: list[str], seen: Seen, dt: float) -> _Floats:
    """Returns the highest speeds that limits leave, `(D,)`, m/s.

    For a limit no vehicle brakes harder than its `decel`.
    """
    speed, highest = seen.speed.numpy(), seen.allowed.numpy()
    too_fast = np.flatnonzero(speed > highest).tolist()
    if too_fast:
        highest = highest.copy()
    for index in too_fast:
        slowest = speed[index] - connection.vehicle.getDecel(names[index]) * dt
        highest[index] = max(highest[index], slowest)
    return highest
