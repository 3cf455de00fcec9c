"""Newell's simplified model (`newell`).

G. F. Newell (2002), *A simplified car-following theory: a lower order model*, Transportation
Research Part B 36(3), 195-205.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace, bumper_gap

_SOURCE = (
    "Newell (2002); default: with a car of 4.5 m a wave of (d + 4.5 m) / tau = 5 m/s runs upstream,"
    " as is observed"
)


class Newell(DrivingModel):
    """Repeats the leader's path, a time tau later and a distance d behind.

    The paper: `x(t + tau) = x_l(t) - length - d`, unless the road is free. With g the bumper gap,
    the speed that gets there is

        v' = max(0, min(v_f, (g - d) / max(tau, dt)))

    At equilibrium (v = v_l < v_f) the gap is `d + v tau`, for every speed: that is the paper's
    straight line of spacing over speed.

    Differences from the paper: the paper's path is the leader's with a *delay* of tau. A step would
    need tau seconds of the leader's past, and the window that a calibration simulates is shorter
    than that. Here the speed is a function of the present gap. For `dt = tau` that is the paper's
    model to the last digit. For shorter steps the follower's position lags behind the leader's like
    a first-order low pass with time constant tau: it has the same steady states, the same delay for
    slow changes, and a gap smaller by `a tau^2 / 2` behind a leader with acceleration a;
    oscillations of angular frequency w come out smaller by `1 / sqrt(1 + w^2 tau^2)` instead of
    unchanged. The paper's d includes the leader's length. The follower's present speed does not
    matter: a first-order model has no inertia, and its first step may jump.

    Differences from SUMO: SUMO has no Newell model.
    """

    reference = "Newell (2002), Transp. Res. B 36(3)"
    search_effort = 3.0
    parameters = ParameterSpace.of(
        Parameter("tau", "s", 0.3, 10.0, 1.4, "time by which the path is shifted", _SOURCE),
        Parameter(
            "d",
            "m",
            0.0,
            20.0,
            2.5,
            "distance by which the path is shifted: gap at standstill",
            _SOURCE,
        ),
        Parameter(
            "v_f",
            "m/s",
            1.0,
            70.0,
            120 / 3.6,
            "speed on a free road",
            "Newell (2002); default: as cfx-community's v0",
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        # In less than a step the follower would drive past the end of the leader's path.
        following = (bumper_gap(follower, leader) - p["d"]) / p["tau"].clamp(min=dt)
        return torch.minimum(following, p["v_f"]).clamp(min=0.0)
