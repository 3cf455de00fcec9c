"""A model: how fast a driver goes next. This one is linear.

A simulator calls `next_speed` at each time step, for all drivers and all candidate parameters at
once: in calibration, in training and in evaluation. `parameters` says what calibration may choose.

W. Helly (1959), Simulation of bottlenecks in single-lane traffic flow, Proc. Symposium on Theory of
Traffic Flow.
"""

from __future__ import annotations

from collections.abc import Mapping

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace, bumper_gap
from torch import Tensor


class Helly(DrivingModel):
    """Accelerates in proportion to the speed difference and to the error of the gap.

    a = k_v (v_l - v) + k_g (g - d - t_gap v), cut off at a_max and -b_max; g is the gap bumper to
    bumper. In equilibrium (v = v_l) the gap is d + t_gap v.

    Differences from the paper: the leader's acceleration plays no part, there is no reaction time,
    and accelerations are bounded.
    """

    reference = "Helly (1959), Proc. Symposium on Theory of Traffic Flow"

    parameters = ParameterSpace.of(
        Parameter("t_gap", "s", 0.3, 4.0, 1.4, "time gap kept when following", "usual time gaps"),
        Parameter("k_v", "1/s", 0.05, 2.0, 0.5, "answer to speed differences", "Helly (1959), C1"),
        Parameter("k_g", "1/s2", 0.01, 1.0, 0.125, "answer to gap errors", "Helly (1959), C2"),
        Parameter("d", "m", 0.5, 10.0, 2.5, "gap at standstill", "SUMO's minGap", tuned=False),
        Parameter("a_max", "m/s2", 0.5, 6.0, 2.6, "acceleration", "SUMO's accel", tuned=False),
        Parameter(
            "b_max", "m/s2", 1.0, 20.0, 9.0, "deceleration", "SUMO's emergencyDecel", tuned=False
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        error = bumper_gap(follower, leader) - p["d"] - p["t_gap"] * follower.speed
        acceleration = p["k_v"] * (leader.speed - follower.speed) + p["k_g"] * error
        acceleration = acceleration.minimum(p["a_max"]).maximum(-p["b_max"])
        return (follower.speed + acceleration * dt).clamp(min=0.0)
