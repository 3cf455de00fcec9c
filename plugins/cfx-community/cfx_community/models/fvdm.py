"""The full-velocity-difference model (`fvdm`).

R. Jiang, Q. Wu and Z. Zhu (2001), *Full velocity difference model for a car-following theory*,
Physical Review E 64(1), 017101; in SI units: M. Treiber and A. Kesting (2013), *Traffic Flow
Dynamics*, section 10.7.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace, bumper_gap
from cfx_community.models.optimal_velocity import OPTIMAL_VELOCITY, optimal_velocity

_BOOK = (
    "default: Treiber and Kesting (2013), section 10.7;"
    " bounds: about those of Kesting and Treiber (2008)"
)


class FVDM(DrivingModel):
    """Relaxes towards the optimal velocity of the gap, and towards the leader's speed.

    With s the bumper gap and V(s) as in `ovm`:

        dv/dt = (V(s) - v) / tau + lambda (v_l - v)     lambda = 0 for s > reach
        v'    = max(0, v + dv/dt dt)

    At equilibrium the gap is that of `ovm`. A platoon is string stable where
    `V'(s) <= 1 / (2 tau) + lambda`.

    Differences from the paper: V is the function of `ovm`, not Helbing and Tilch's (1998) fit, and
    it depends on the bumper gap. lambda is one number up to `reach` (100 m, as in the paper) and 0
    beyond; the paper also allows a second value there. The step is forward Euler in dt; the paper's
    model is continuous in time. As in the paper, the response to a speed difference does not depend
    on the gap: the follower brakes for a standing leader within `reach`, and for no leader beyond.

    Differences from SUMO: SUMO has no full-velocity-difference model.
    """

    reference = (
        "Jiang, Wu and Zhu (2001), Phys. Rev. E 64, 017101;"
        " Treiber and Kesting (2013), section 10.7"
    )
    parameters = ParameterSpace.of(
        *OPTIMAL_VELOCITY,
        Parameter(
            "tau", "s", 0.2, 20.0, 5.0, "relaxation time", f"{_BOOK}, low: for Euler steps of 0.1 s"
        ),
        Parameter("lambda", "1/s", 0.0, 3.0, 0.6, "sensitivity to the speed difference", _BOOK),
        Parameter(
            "reach",
            "m",
            10.0,
            500.0,
            100.0,
            "gap beyond which lambda is 0",
            "Jiang et al. (2001)",
            tuned=False,
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        v = follower.speed
        gap = bumper_gap(follower, leader)
        sensitivity = torch.where(gap <= p["reach"], p["lambda"], 0.0)
        acceleration = (optimal_velocity(gap, p) - v) / p["tau"] + sensitivity * (leader.speed - v)
        return (v + acceleration * dt).clamp(min=0.0)
