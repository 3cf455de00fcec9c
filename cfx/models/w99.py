"""Wiedemann's 1999 model (`w99`), as SUMO computes it.

R. Wiedemann's psycho-physical model in its ten-parameter form: PTV Vissim's user manual names the
parameters CC0 to CC9; the decision rules are those of SUMO's implementation (M. Gao, *Wiedemann 99
in SUMO*), restated here from measured behaviour.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from cfx.core.component import Settings
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader, ModelSettings, bumper_gap
from cfx.models.regimes import (
    SPACING_WIDTH,
    SPEED_WIDTH,
    safe_divisor,
    safe_sqrt,
    switches_exactly,
    where_below,
    where_up_to,
)
from cfx.models.vtype import VType, sumo_speed

_VISSIM = "default: Vissim and SUMO; bounds: the ranges used in the calibration literature"
_SUMO = "SUMO's default passenger car"
_RESERVE = 0.1  # share of CC0 that is never given up (SUMO's collisionMinGapFactor)
_CC9_SPEED = 22.2  # m/s (80 km/h): where CC9 applies


class W99Settings(ModelSettings):
    """Settings of `w99`."""

    variant: Literal["sumo", "vissim"] = Field(
        "sumo",
        description="sumo: CC8 caps every acceleration, so CC9 has no effect; vissim: CC8 at"
        " standstill to CC9 at 80 km/h",
    )


class W99(DrivingModel):
    """Keeps a gap between two thresholds and reacts to speed differences that it can perceive.

    With dx the bumper gap, dv = v_l - v and a_old the follower's last acceleration:

        near  = CC0 + CC1 v (CC0 alone if the leader stands)     far  = near + CC2
        perc  = far + CC3 (dv - CC4)                             s    = CC6 dx^2 / 10^4
        close = CC4 - s (0 if the follower stands)               open = s + CC5 if v_l > CC5 else s

    The first case that holds decides on the acceleration:

    1. *Too close*, dv < open and dx <= near. Let blocked = 0, but as hard as the brakes go if one
       more step at this speed ends less than a tenth of CC0 behind where the leader is now (dx < v
       dt + CC0 / 10). Behind a standing leader a = blocked. Otherwise a = blocked if dv >= 0;
       min(0, a_l + dv^2 / (CC0 - dx)) if dv < 0 and dx > CC0; min(0, a_l + (dv - open) / 2) if dv <
       0 and dx <= CC0; then -CC7 if a > -CC7, else max(a, -10 + sqrt(v) / 2).
    2. *Approaching*, dv < close and dx < perc: a = dv^2 / (2 (near - dx - 0.1)).
    3. *Following*, dv < open and dx < far: a = min(a_old, -CC7) if a_old <= 0 else max(a_old, CC7).
    4. *Free*, dx > near: a = min(dv^2 / (far - dx), amax) if dx < far, else amax. Where dx <= near:
       0.

    In case 4 amax = CC8 + CC9 min(v, 22.2). SUMO realises the result with CC8 as the cap on
    acceleration, so amax is never felt, **CC9 has no effect** and is not tuned (`variant=vissim`
    reads it as Vissim does: amax goes from CC8 at standstill to CC9 at 80 km/h, and is the cap).

    Differences from SUMO: this is the deterministic part. SUMO adds u in [0, 1) to amax (cut off by
    the cap) and, while closing in on a leader that accelerates by 1 m/s2 or more, takes CC1 max(0,
    v_l + dv r) with r in [-0.5, 0.5) for CC1 v; here that is CC1 v always. SUMO's gap to be kept,
    minGap, is CC0.

    Differences from the paper: it lists the 1974 thresholds but ran SUMO's ten-parameter model,
    which this is.

    Not differentiable in the thresholds themselves: gradients are those of the case that holds.
    `at_temperature` makes them differentiable for training.
    """

    reference = "Wiedemann (1974, 1999); PTV Vissim manual, CC0 to CC9; SUMO's carFollowModel W99"
    schema: ClassVar[type[Settings]] = W99Settings
    settings: W99Settings
    # Chosen on simulated drivers of 60 s: 90 % intervals hold 89 to 92 % of their parameters with
    # 0.5, 92 to 93 % with 0.3, 76 to 87 % with 1. docs/how-to/uncertainty.md has those of others.
    likelihood_power: ClassVar[float] = 0.5

    parameters = ParameterSpace.of(
        Parameter("cc0", "m", 0.1, 5.0, 2.5, "gap at standstill", "default: SUMO's minGap"),
        Parameter("cc1", "s", 0.1, 6.0, 1.3, "time gap kept above cc0", _VISSIM),
        Parameter(
            "cc2", "m", 0.5, 20.0, 8.0, "how far the gap oscillates above the safe one", _VISSIM
        ),
        Parameter(
            "cc3",
            "s",
            -30.0,
            -2.0,
            -12.0,
            "perception threshold: how early braking for a slower leader begins",
            _VISSIM,
        ),
        Parameter(
            "cc4",
            "m/s",
            -2.0,
            -0.01,
            -0.25,
            "negative speed difference perceived while following",
            _VISSIM,
        ),
        Parameter(
            "cc5",
            "m/s",
            0.01,
            2.0,
            0.35,
            "positive speed difference perceived while following",
            _VISSIM,
        ),
        Parameter(
            "cc6",
            "1e-4/(m s)",
            0.0,
            20.0,
            6.0,
            "how much perception worsens with distance",
            _VISSIM,
        ),
        Parameter("cc7", "m/s2", 0.01, 1.0, 0.25, "acceleration while oscillating", _VISSIM),
        Parameter(
            "cc8",
            "m/s2",
            0.5,
            5.0,
            2.0,
            "acceleration from standstill; cap on every acceleration",
            _VISSIM,
        ),
        Parameter(
            "cc9",
            "m/s2",
            0.1,
            4.0,
            1.5,
            "acceleration at 80 km/h; no effect in variant=sumo",
            _VISSIM,
            used_with=("variant", "vissim"),
        ),
        Parameter(
            "b",
            "m/s2",
            1.0,
            9.0,
            4.5,
            "deceleration above which braking counts as an emergency",
            _SUMO,
            tuned=False,
        ),
        Parameter(
            "b_max", "m/s2", 1.0, 20.0, 9.0, "brake cap", "SUMO's emergencyDecel", tuned=False
        ),
        Parameter("v_max", "m/s", 5.0, 70.0, 55.0, "maximum speed", _SUMO, tuned=False),
    )

    @property
    def brakes_within_bounds(self) -> bool:
        return True

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        cc0, cc4, cc5, cc7, cc8 = p["cc0"], p["cc4"], p["cc5"], p["cc7"], p["cc8"]
        dx = bumper_gap(follower, leader)
        v, a_old = follower.speed, follower.acceleration
        v_l, a_l = leader.speed, leader.acceleration
        dv = v_l - v
        near = torch.where(v_l > 0, cc0 + p["cc1"] * v, cc0)
        far = near + p["cc2"]
        perceived = far + p["cc3"] * (dv - cc4)
        sensitivity = p["cc6"] * dx * dx * 1e-4
        closing_threshold = torch.where(v > 0, cc4 - sensitivity, 0.0)
        opening_threshold = torch.where(v_l > cc5, sensitivity + cc5, sensitivity)

        # 1. Too close. One step more at this speed ends less than a tenth of CC0 behind where the
        # leader is now: brake.
        blocked = torch.where(dx < v * dt + _RESERVE * cc0, -p["b_max"], 0.0)
        beyond = dx > cc0
        brake = a_l + torch.where(
            beyond, dv * dv / safe_divisor(cc0 - dx, beyond), 0.5 * (dv - opening_threshold)
        )
        brake = torch.where(dv < 0, brake.clamp(max=0.0), blocked)
        brake = torch.where(brake > -cc7, -cc7, torch.maximum(brake, 0.5 * safe_sqrt(v) - 10.0))
        too_close = torch.where(v_l > 0, brake, blocked)
        # 2. Approaching.
        room = near - dx - 0.1
        approaching = 0.5 * dv * dv / safe_divisor(room, room.abs() > 0)
        # 3. Following, unconsciously.
        following = torch.where(a_old <= 0, torch.minimum(a_old, -cc7), torch.maximum(a_old, cc7))
        # 4. Free, or closing the gap.
        a_max, cap = self._limits(v, cc8, p["cc9"])
        inside = dx < far
        free = torch.where(
            inside, torch.minimum(dv * dv / safe_divisor(far - dx, inside), a_max), a_max
        )
        free = torch.where(dx > near, free, 0.0)

        if not switches_exactly(self.temperature):
            # They are mixed, so each must be something that the vehicle can do.
            hardest = -p["b_max"]
            approaching = approaching.clamp(min=hardest).minimum(cap)
            too_close = too_close.clamp(min=hardest).minimum(cap)
            free = free.clamp(min=hardest).minimum(cap)
        # Nested, not joined by `&`: compiled in float64 that is three times as fast (masks of
        # doubles are joined as integers).
        near_by = partial(where_below, scale=SPACING_WIDTH, temperature=self.temperature)
        slower = partial(where_below, scale=SPEED_WIDTH, temperature=self.temperature)
        otherwise = slower(dv, opening_threshold, near_by(dx, far, following, free), free)
        otherwise = slower(
            dv, closing_threshold, near_by(dx, perceived, approaching, otherwise), otherwise
        )
        too_near = where_up_to(
            dx, near, too_close, otherwise, scale=SPACING_WIDTH, temperature=self.temperature
        )
        acceleration = slower(dv, opening_threshold, too_near, otherwise)
        proposed = v + acceleration * dt
        return sumo_speed(
            v,
            proposed,
            accel=cap,
            decel=p["b"],
            emergency_decel=p["b_max"],
            v_max=p["v_max"],
            dt=dt,
        )

    def _limits(self, v: Tensor, cc8: Tensor, cc9: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the acceleration wanted on a free road and the cap on every one, m/s2."""
        slow = v.clamp(max=_CC9_SPEED)
        if self.settings.variant == "sumo":
            return cc8 + cc9 * slow, cc8
        free_acceleration = cc8 + (cc9 - cc8) * slow / _CC9_SPEED
        return free_acceleration, free_acceleration

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        if self.settings.variant != "sumo":
            raise ConfigError(
                "simulator=sumo: SUMO has model=w99 as variant=sumo only, not"
                f" {self.settings.variant}"
            )
        names = {"cc0": "minGap", "b": "decel", "b_max": "emergencyDecel", "v_max": "maxSpeed"}
        return VType("W99", {names.get(ours, ours): value for ours, value in p.items()})
