"""The Intelligent Driver Model as SUMO computes it (`idm_sumo`).

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
    sumo_speed,
)

_SUMO = "default: SUMO's passenger car"
_BOUNDS = f"{_SUMO}; bounds: about those of Kesting and Treiber (2008), Transp. Res. Rec. 2088"

_STEPPING = 0.25  # s: SUMO's default; a longer time step is cut into parts about as long
_CLOSEST = 1e-3  # m: what a smaller gap counts as


class IdmSumo(DrivingModel):
    """Accelerates towards a desired speed, and brakes as the gap falls below a desired one.

    With s the bumper gap:

        s* = minGap + max(0, v tau + v (v - v_l) / (2 sqrt(accel decel)))
        dv/dt = accel (1 - (v / maxSpeed)^delta - (s* / s)^2)

    A time step of 0.375 s or more is cut into parts of about 0.25 s, between which s shrinks by
    what the follower gains. Around it SUMO's limits hold: v' is at most v + accel dt and maxSpeed,
    and braking at most emergencyDecel.

    Differences from Treiber, Hennecke and Helbing (2000): these limits; a fast leader never
    shortens s* below minGap; a gap below 1 mm, or none, counts as 1 mm.
    """

    reference = (
        "Treiber, Hennecke and Helbing (2000), Phys. Rev. E 62(2); SUMO's carFollowModel IDM"
    )
    collision_free = True

    parameters = ParameterSpace.of(
        Parameter("tau", "s", 0.1, 5.0, 1.0, "desired time gap", _BOUNDS),
        Parameter("accel", "m/s2", 0.1, 6.0, 2.6, "maximum acceleration", _BOUNDS),
        Parameter("decel", "m/s2", 0.1, 6.0, 4.5, "comfortable deceleration", _BOUNDS),
        Parameter("minGap", "m", 0.1, 8.0, 2.5, "gap at standstill", _BOUNDS),
        Parameter(
            "maxSpeed",
            "m/s",
            1.0,
            70.0,
            33.3,
            "desired speed on a free road",
            "120 km/h; bounds: as tau's",
        ),
        Parameter("delta", "1", 1.0, 8.0, 4.0, "acceleration exponent", "SUMO", tuned=False),
        Parameter("emergencyDecel", "m/s2", 1.0, 20.0, 9.0, "brake cap", _SUMO, tuned=False),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        start, v_l = follower.speed, leader.speed
        parts = max(1, int(dt / _STEPPING + 0.5))
        scale = 2.0 * torch.sqrt(p["accel"] * p["decel"])
        v, gap = start, bumper_gap(follower, leader)
        for _ in range(parts):
            wanted_gap = p["minGap"] + (v * p["tau"] + v * (v - v_l) / scale).clamp(min=0.0)
            crowding = wanted_gap / gap.clamp(min=_CLOSEST)
            acceleration = p["accel"] * (
                1.0 - torch.pow(v / p["maxSpeed"], p["delta"]) - crowding * crowding
            )
            v = (v + acceleration * (dt / parts)).clamp(min=0.0)
            gap = gap - ((v - v_l) * (dt / parts)).clamp(min=0.0)
        return sumo_speed(
            start,
            v,
            accel=p["accel"],
            decel=p["decel"],
            emergency_decel=p["emergencyDecel"],
            v_max=p["maxSpeed"],
            dt=dt,
        )

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        return VType("IDM", dict(p))
