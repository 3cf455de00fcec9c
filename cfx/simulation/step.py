"""One step of one vehicle: the only place that integrates.

Forward Euler with the new speed, as the paper prints it and SUMO does it by default:

    v' = guard(model(...))        x' = x + v' dt        a' = (v' - v) / dt

The guard keeps the vehicle to what it can do (`cfx.models.limits`), so that no change of parameters
makes the speed jump. The model sees the leader at t. The rollout, training through the simulation
and live drivers in SUMO all take this step.

Shapes: `*batch` are any leading dimensions; m is the width of the model's memory.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.limits import limited_speed


def advance_vehicle(
    model: DrivingModel, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
) -> Follower:
    """Returns the follower one time step later.

    Args:
        model: the driving model.
        follower: state at t, `(*batch,)` each, SI units; its memory `(*batch, m)`.
        leader: state at t; broadcasts to `(*batch,)`.
        p: one tensor per parameter, by name; each broadcasts to `(*batch,)`.
        dt: time step, s.

    Returns:
        State at t + dt, in the dtype of the follower.
    """
    desired = model.next_speed(follower, leader, p, dt)
    speed = limited_speed(model.limits, follower.speed, follower.acceleration, desired, dt)
    memory = model.next_memory(follower, leader, p, dt, speed)
    position = follower.position + speed * dt
    acceleration = (speed - follower.speed) / dt
    return Follower(position, speed, acceleration, memory)
