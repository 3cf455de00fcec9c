"""One step of a model, and a platoon behind a leader whose speed swings a little."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Start
from cfx.simulation.rollout import simulate_follower

LENGTH = 5.0


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def next_speed(
    model: DrivingModel, *, gap: float, v: float, v_l: float, dt: float = 0.1, **changes: float
) -> float:
    p = {p.name: number(changes.get(p.name, p.default)) for p in model.space}
    follower = Follower(number(-LENGTH - gap), number(v), number(0.0), torch.zeros(0))
    leader = Leader(number(0.0), number(v_l), number(0.0), number(LENGTH))
    return model.next_speed(follower, leader, p, dt).item()


def gain(
    model: DrivingModel,
    p: Mapping[str, Tensor],
    *,
    gap: Tensor,
    speed: Tensor,
    pace: float,
    dt: float = 0.02,
) -> Tensor:
    """Returns by how much each follower amplifies a swing of its leader's speed, `(n,)`.

    The leaders drive at `speed` plus a swing of 1 cm/s and of angular frequency `pace`, 1/s. The
    followers start at the equilibrium `gap`; both `(n,)`. The last of four periods is measured,
    when the transient of the start has died away.
    """
    period = 2 * math.pi / pace
    t = torch.arange(round(4 * period / dt), dtype=torch.float64) * dt
    swing = 0.01
    v_l = speed[:, None] + swing * torch.sin(pace * t)
    x_l = speed[:, None] * t + swing / pace * (1 - torch.cos(pace * t))
    leader = Leader(x_l, v_l, torch.zeros_like(v_l), torch.full_like(speed, LENGTH))
    out = simulate_follower(
        model, p, leader, Start(-LENGTH - gap, speed, torch.zeros_like(speed)), dt
    )
    last = out.speed[:, -round(period / dt) :]
    return (last.amax(dim=1) - last.amin(dim=1)) / (2 * swing)
