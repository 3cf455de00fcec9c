"""Krauss's safe-speed model.

S. Krauß (1998), *Microscopic modeling of traffic flow: investigation of collision free vehicle
dynamics*, DLR Forschungsbericht 98-08; in the form with reaction and brake build-up time of Yang,
Masuda and Tatsubori (2021).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from cfx.core.component import Settings
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader, ModelSettings, bumper_gap
from cfx.models.regimes import safe_sqrt
from cfx.models.vtype import VType, sumo_speed

_PAPER = "Yang et al. (2021); bounds: wide enough for drivers who stay far behind"
_SUMO = "SUMO's default passenger car"


class KraussSettings(ModelSettings):
    """Settings of `krauss`."""

    variant: Literal["paper", "sumo"] = Field(
        "paper",
        description="paper: the equations as derived; sumo: with KraussOrig1's brake cap,"
        " standing-leader rule and rounding",
    )
    leader_deceleration: float | None = Field(
        None,
        gt=0,
        le=50,
        description="b_l, m/s2: deceleration expected of the leader; null: the same as b",
    )


class Krauss(DrivingModel):
    """Drives as fast as it safely can.

    A driver's stopping distance is `v t_lag + v^2 / (2 b)`; the follower lags by `t_r + t_i / 2`
    (reaction plus half the brake build-up time), the leader by `t_i / 2`. Safe is the speed from
    which the follower can stop within the gap g plus the leader's stopping distance:

        T      = t_r + t_i / 2
        v_safe = -b T + sqrt(b^2 T^2 + b (v_l t_i + v_l^2 / b_l + 2 (g - min_gap)))
        v'     = max(0, min(v_max, v + a dt, v_safe))

    At equilibrium (v = v_l) the gap is `v t_r + min_gap` whatever t_i, if b_l = b.

    Differences from the paper: the printed v_safe is dimensionally wrong (`v_i t_i * v_t^2 / a` for
    `v_l t_i + v_l^2 / b_l`, and 2 g outside the product with b). A negative radicand (the gap is
    gone) gives v_safe = -b T, hence a stop.

    Differences from SUMO: with t_i = 0 and `variant=sumo` the model is SUMO's KraussOrig1 with tau
    = t_r, sigma = 0 and minGap = min_gap, but for a negative radicand, where SUMO gets NaN and
    ignores the leader.
    """

    reference = "Krauß (1998), DLR-FB 98-08; Yang, Masuda and Tatsubori (2021)"
    collision_free = True
    schema: ClassVar[type[Settings]] = KraussSettings
    settings: KraussSettings

    parameters = ParameterSpace.of(
        Parameter("t_r", "s", 0.1, 10.0, 1.5, "reaction time; the equilibrium time gap", _PAPER),
        Parameter("t_i", "s", 0.0, 2.0, 0.15, "brake build-up time", _PAPER),
        Parameter("a", "m/s2", 0.5, 6.0, 2.6, "maximum acceleration", _SUMO, tuned=False),
        Parameter(
            "b", "m/s2", 1.0, 9.0, 4.5, "deceleration the follower plans with", _SUMO, tuned=False
        ),
        Parameter("v_max", "m/s", 5.0, 70.0, 55.0, "maximum speed", _SUMO, tuned=False),
        Parameter(
            "min_gap",
            "m",
            0.0,
            10.0,
            0.0,
            "gap kept at standstill; 2.5 in SUMO",
            "Yang et al. (2021)",
            tuned=False,
        ),
        Parameter(
            "b_max",
            "m/s2",
            1.0,
            20.0,
            9.0,
            "brake cap, in variant=sumo only",
            "SUMO's emergencyDecel",
            tuned=False,
            used_with=("variant", "sumo"),
        ),
    )

    @property
    def brakes_within_bounds(self) -> bool:
        return self.limits is not None or self.settings.variant == "sumo"

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        b = p["b"]
        b_l: Tensor | float = b
        if self.settings.leader_deceleration is not None:
            b_l = self.settings.leader_deceleration
        g = bumper_gap(follower, leader) - p["min_gap"]
        v, v_l = follower.speed, leader.speed
        lag = p["t_r"] + 0.5 * p["t_i"]
        radicand = b * b * lag * lag + b * (v_l * p["t_i"] + v_l * v_l / b_l + 2.0 * g)
        v_safe = safe_sqrt(radicand) - b * lag
        if self.settings.variant == "paper":
            return torch.minimum(torch.minimum(v + p["a"] * dt, p["v_max"]), v_safe).clamp(min=0.0)
        creep = torch.where(g <= b * dt, torch.minimum(b * dt, g / dt), v_safe)
        v_safe = torch.where(v_l == 0, torch.where(g < 0.01, 0.0, creep), v_safe)
        return sumo_speed(
            v, v_safe, accel=p["a"], decel=b, emergency_decel=p["b_max"], v_max=p["v_max"], dt=dt
        )

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        lag = self.space["t_i"]
        if (
            self.settings.variant != "sumo"
            or self.settings.leader_deceleration is not None
            or lag.tuned
            or lag.default != 0
        ):
            raise ConfigError(
                "simulator=sumo: SUMO has model=krauss (its KraussOrig1) only without a brake"
                " build-up time; add model.variant=sumo model.leader_deceleration=null"
                " model.parameters.t_i.default=0 model.parameters.t_i.tuned=false, or choose"
                " model=krauss_sumo"
            )
        names = {
            "t_r": "tau",
            "a": "accel",
            "b": "decel",
            "v_max": "maxSpeed",
            "min_gap": "minGap",
            "b_max": "emergencyDecel",
        }
        return VType("KraussOrig1", {theirs: p[ours] for ours, theirs in names.items()})
