"""SUMO's Euler step around every car-following model.

It is restated from measured behaviour (SUMO 1.28).
"""

from __future__ import annotations

import torch
from torch import Tensor


def sumo_speed(
    v: Tensor,
    wanted: Tensor,
    *,
    accel: Tensor,
    decel: Tensor,
    emergency_decel: Tensor,
    v_max: Tensor,
    dt: float,
) -> Tensor:
    """Returns the speed `(*batch,)`, m/s, that SUMO realises when a model wants `wanted`.

    With `top = min(v + accel dt, v_max)` the plan is `min(top, wanted)`; it is bounded by 0 and by
    `v - emergency_decel dt`, so that `emergency_decel` is the brake cap, not `decel`, unless that
    is the larger one. Speeds below 1e-5 m/s become 0. The lane's limit is taken to be above
    `v_max`.

    Args:
        v: speed now, m/s.
        wanted: speed that the model asks for, m/s; may be negative.
        accel, decel, emergency_decel: m/s2, positive.
        v_max: m/s.
        dt: time step, s.
    """
    top = torch.minimum(v + accel * dt, v_max)
    comfortable = (v - decel * dt).clamp(min=0.0)
    plan = torch.minimum(top, wanted)
    hardest = torch.minimum(comfortable, (v - emergency_decel * dt).clamp(min=0.0))
    speed = torch.maximum(plan, hardest)
    return torch.where(speed.abs() < 1e-5, 0.0, speed)
