"""The full-velocity-difference model (`fvdm`).

R. Jiang, Q. Wu and Z. Zhu (2001), *Full velocity difference model for a car-following theory*, Physical Review E 64(1), 017101;
in SI units: M. Treiber and A. Kesting (2013), *Traffic Flow Dynamics*, section 10.7.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx import DrivingModel, Follower, Leader, Parameter, ParameterSpace, bumper_gap
from cfx_classics.optimal_velocity import OPTIMAL_VELOCITY, optimal_velocity

_BOOK = "default: Treiber and Kesting (2013), section 10.7; bounds: about those of Kesting and Treiber (2008)"


class FVDM(DrivingModel):
    """Relaxes towards the speed that the gap deserves, and towards the leader's.

    With s the bumper gap and V(s) as in `ovm`:

        dv/dt = (V(s) - v) / tau + lambda (v_l - v)     lambda = 0 for s > reach
        v'    = max(0, v + dv/dt dt)

    At equilibrium the gap is that of `ovm`. A platoon is string stable where `V'(s) <= 1 / (2 tau) + lambda`.

    Differences from the paper: V is the function of `ovm`, not Helbing and Tilch's (1998) fit, and of the bumper gap; lambda
    is one number up to `adaptation_bounds` (100 m, as the paper has it) and 0 beyond, where the paper also allows a second one. Forward
    Euler in dt for a model that is continuous in time. As in the paper the response to a speed difference does not depend on
    the gap, so a leader far ahead who stands is braked for up to `adaptation_bounds` and no further.

    Differences from SUMO: SUMO has no full-velocity-difference model.
    """

    reference = "Jiang, Wu and Zhu (2001), Phys. Rev. E 64, 017101; Treiber and Kesting (2013), section 10.7"
    parameters = ParameterSpace.of(
        *OPTIMAL_VELOCITY,
        Parameter(
            "tau", "s", 0.2, 20.0, 5.0, "relaxation time", f"{_BOOK}, low: for Euler steps of 0.1 s"
        ),
        Parameter("lambda", "1/s", 0.0, 3.0, 0.6, "sensitivity to the speed difference", _BOOK),
        Parameter(
            "adaptation_bounds",
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
        v, gap = follower.speed, bumper_gap(follower, leader)
        sensitivity = torch.where(gap <= p["adaptation_bounds"], p["lambda"], 0.0)
        acceleration = (optimal_velocity(gap, p) - v) / p["tau"] + sensitivity * (leader.speed - v)
        return (v + acceleration * dt).clamp(min=0.0)
