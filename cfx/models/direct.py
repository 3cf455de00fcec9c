"""No driving model: the parameter is the acceleration itself."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models.base import DrivingModel, Follower, Leader


class Direct(DrivingModel):
    """Drives with the acceleration that it is given: the upper reference of adaptive models.

        v' = max(0, min(v_max, v + acceleration dt))

    A policy that drives it sets the acceleration anew for each window. No equation of traffic
    stands between the policy and the vehicle. So this shows how close a policy can come to a driver
    from what it sees, and what a driving model with few parameters costs beside it. It does not
    show safety. Nothing keeps the vehicle from running into its leader, or from driving senselessly
    behind a leader unlike those that the policy has learned from.

    With constant parameters it holds a constant acceleration, whatever its leader does. So its
    `default`, `pooled` and `driver_specific` are no baselines and improvements over them mean
    nothing (`has_constant_baseline = False`; reports leave them out). Compare its absolute RMSE
    with other jobs' on the same data.
    """

    reference = "longitudinal kinematics, forward Euler"
    has_constant_baseline = False

    parameters = ParameterSpace.of(
        Parameter(
            "acceleration",
            "m/s2",
            -8.0,
            4.0,
            0.0,
            "acceleration until the next choice",
            "what tyres and engine give",
        ),
        Parameter(
            "v_max",
            "m/s",
            5.0,
            70.0,
            55.0,
            "maximum speed",
            "SUMO's default passenger car",
            tuned=False,
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        return torch.minimum(follower.speed + p["acceleration"] * dt, p["v_max"]).clamp(min=0.0)
