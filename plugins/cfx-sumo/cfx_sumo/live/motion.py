"""Steps of the driving model in a running simulation, within the limits that SUMO puts around them.

Shapes: D vehicles.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.plugin import (
    Agent,
    DrivingModel,
    Follower,
    Leader,
    LimitSettings,
    advance_vehicle,
    at_limits,
)
from cfx_sumo.live.braking import hardest_braking
from cfx_sumo.live.surroundings import Connection, Seen
from cfx_sumo.live.vehicles import KnownVehicles


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
        self._model = model
        self._vehicles = vehicles
        self._bounds_braking = bounds_braking

    def begin(self, row: int, speed: Tensor) -> None:
        """Begins the model's memory of a vehicle that drives at `speed`, `()`, m/s."""
        self._vehicles.table.memory[row] = self._driven.initial_memory(speed)

    def take(
        self, connection: Connection, names: list[str], rows: Tensor, seen: Seen, dt: float
    ) -> tuple[Tensor, Tensor]:
        """Takes a step of the model.

        Args:
            connection: to the simulation.
            names: the vehicles.
            rows: theirs, `(D,)` int64.
            seen: what they do.
            dt: the step, s.

        Returns:
            The next speeds `(D,)`, m/s; and how hard vehicles must be able to brake for them, m/s2,
            0 where comfortably is enough.
        """
        table = self._vehicles.table
        follower = Follower(
            torch.zeros_like(seen.speed), seen.speed, seen.acceleration, table.memory[rows]
        )
        zero = torch.zeros_like(seen.gap)
        leader = Leader(seen.gap, seen.leader_speed, seen.leader_acceleration, zero)
        p = self._space.unpack(table.parameters[rows])
        after = advance_vehicle(self._driven, follower, leader, p, dt)
        table.memory[rows] = after.memory
        speed, bound = after.speed, torch.zeros_like(seen.speed)
        limits = self._model.limits
        if limits is not None and self._bounds_braking:
            speed, bound = _comfortable(connection, names, seen, speed, limits, dt)
        return torch.minimum(speed, _allowed(connection, names, seen, dt)), bound

    def count_limited(self, before: Tensor, after: Tensor, dt: float) -> int:
        """Returns how many vehicles are at a limit of acceleration, of speeds `(D,)` in m/s."""
        speeds = torch.stack([before, after], -1)
        return int(at_limits(self._model.limits, speeds, dt)[:, 1].sum())


def _comfortable(
    connection: Connection,
    names: list[str],
    seen: Seen,
    speed: Tensor,
    limits: LimitSettings,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """Raises speeds `(D,)` so that vehicles brake comfortably, unless their `minGap` needs more.

    Returns:
        The speeds `(D,)`, m/s; and how hard vehicles must be able to brake, `(D,)`, m/s2, 0 where
        comfortably is enough.
    """
    hardest = hardest_braking(seen, limits)
    beyond = hardest > limits.comfortable_deceleration
    for index in beyond.nonzero().flatten().tolist():
        emergency = connection.vehicle.getEmergencyDecel(names[index])
        hardest[index] = min(float(hardest[index]), emergency)
    speed = torch.maximum(speed, (seen.speed - hardest * dt).clamp(min=0.0))
    return speed, torch.where(hardest > limits.comfortable_deceleration, hardest, 0.0)


def _allowed(connection: Connection, names: list[str], seen: Seen, dt: float) -> Tensor:
    """Returns the highest speeds that limits leave, `(D,)`, m/s.

    For a limit no vehicle brakes harder than its `decel`.
    """
    highest = seen.allowed.clone()
    for index in (seen.speed > seen.allowed).nonzero().flatten().tolist():
        slowest = seen.speed[index] - connection.vehicle.getDecel(names[index]) * dt
        highest[index] = max(highest[index], slowest)
    return highest
