"""SUMO's default car-following model (`krauss_sumo`).

It is restated from measured behaviour (SUMO 1.28).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import (
    DrivingModel,
    Follower,
    Leader,
    Parameter,
    ParameterSpace,
    VType,
    bumper_gap,
    regimes,
    sumo_speed,
)

_SUMO = "default: SUMO's passenger car"
_BOUNDS = f"{_SUMO}; bounds: wide enough for drivers who stay far behind"

_MARGIN = 1e-3  # m, and m/s2: what SUMO counts as nothing
_ALARM = 1.2  # how much harder than needed SUMO brakes in an emergency


class KraussSumo(DrivingModel):
    """Drives as fast as it can still stop behind a braking leader, in SUMO's own steps.

    With g = gap - minGap, speeds that fall by `decel dt` in each step, and D_l the way on which the
    leader stops like that (with the harder of decel and its own decel_leader), safe is the largest
    x with

        x tau + dt sum_k max(0, x - k decel dt) <= g + D_l - 0.001

    Where reaching x needs a harder braking than decel, it brakes with 1.2 b instead, but no softer
    than decel and no harder than reaching x needs, b being what the situation asks for: v^2 / (2 (g
    + v_l^2 / (2 d))), or, where that is above d, (v^2 - v_l^2) / (2 g), with d = decel_leader;
    emergencyDecel where g = 0. Where g < 0 it brakes as hard as it can.

        v' = max(0, min(maxSpeed, v + accel dt, x)), braking no harder than emergencyDecel

    This is what SUMO runs where no carFollowModel is given, with sigma = 0. Differences from Krauß
    (1998) and from `krauss`: whole braking steps take the place of v^2 / (2 b); the emergency rule;
    the leader's own deceleration.
    """

    reference = "Krauß (1998), DLR-FB 98-08; SUMO's carFollowModel Krauss"
    collision_free = True

    parameters = ParameterSpace.of(
        Parameter("tau", "s", 0.1, 10.0, 1.0, "time gap kept", _BOUNDS),
        Parameter("accel", "m/s2", 0.5, 6.0, 2.6, "maximum acceleration", _SUMO),
        Parameter("decel", "m/s2", 1.0, 9.0, 4.5, "deceleration it plans with", _SUMO),
        Parameter("minGap", "m", 0.0, 10.0, 2.5, "gap kept at standstill", _SUMO),
        Parameter("maxSpeed", "m/s", 5.0, 70.0, 55.0, "maximum speed", _SUMO, tuned=False),
        Parameter("emergencyDecel", "m/s2", 1.0, 20.0, 9.0, "brake cap", _SUMO, tuned=False),
        Parameter(
            "decel_leader",
            "m/s2",
            1.0,
            9.0,
            4.5,
            "deceleration expected of the leader",
            _SUMO,
            tuned=False,
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        v, v_l, decel = follower.speed, leader.speed, p["decel"]
        gap = bumper_gap(follower, leader) - p["minGap"]
        ahead = _stopping(v_l, torch.maximum(decel, p["decel_leader"]) * dt, dt)
        safe = _safe_speed(gap + ahead - _MARGIN, decel * dt, p["tau"], dt)
        needed = (v - safe) / dt
        eased = torch.minimum(torch.maximum(_ALARM * _emergency(gap, v, v_l, p), decel), needed)
        hard = (v - eased * dt).clamp(min=0.0)
        wanted = torch.where(needed > decel + _MARGIN, hard, safe)
        wanted = torch.where(gap < 0, 0.0, wanted)
        return sumo_speed(
            v,
            wanted,
            accel=p["accel"],
            decel=decel,
            emergency_decel=p["emergencyDecel"],
            v_max=p["maxSpeed"],
            dt=dt,
        )

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        attributes = {
            name: p[name]
            for name in ("tau", "accel", "decel", "minGap", "maxSpeed", "emergencyDecel")
        }
        return VType("Krauss", attributes, leader={"decel": p["decel_leader"]})


def _stopping(speed: Tensor, drop: Tensor, dt: float) -> Tensor:
    """Returns the stopping distance, m, of a speed that falls by `drop`, m/s, in each step."""
    steps = torch.floor(speed / drop)
    return dt * (steps * speed - 0.5 * drop * steps * (steps + 1.0))


def _safe_speed(room: Tensor, drop: Tensor, tau: Tensor, dt: float) -> Tensor:
    """Returns the largest speed from which a vehicle stops within `room`, m.

    It drives for `tau` at full speed, then in steps that each lose `drop`, m/s. With n braking
    steps the way is `x tau + dt (n x - drop n (n + 1) / 2)`; n is the largest for which `n drop`
    still stops.
    """
    room = room.clamp(min=0.0)
    half = tau / dt - 0.5
    steps = torch.floor(regimes.safe_sqrt(half * half + 2.0 * room / (dt * drop)) - half).clamp(
        min=0.0
    )
    return (room + 0.5 * dt * drop * steps * (steps + 1.0)) / (tau + steps * dt)


def _emergency(gap: Tensor, v: Tensor, v_l: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """Returns the deceleration, m/s2, that the situation asks for."""
    decel, open_ = p["decel_leader"], gap > 0
    first = 0.5 * v * v / regimes.safe_divisor(gap + 0.5 * v_l * v_l / decel, open_)
    second = 0.5 * (v * v - v_l * v_l) / regimes.safe_divisor(gap, open_)
    return torch.where(open_, torch.where(first <= decel, first, second), p["emergencyDecel"])
