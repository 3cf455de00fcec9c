"""The optimal-velocity model (`ovm`).

M. Bando, K. Hasebe, A. Nakayama, A. Shibata and Y. Sugiyama (1995), *Dynamical model of traffic
congestion and numerical simulation*, Physical Review E 51(2), 1035-1042; in SI units: M. Treiber
and A. Kesting (2013), *Traffic Flow Dynamics*, section 10.6.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace, bumper_gap
from cfx_community.models.optimal_velocity import OPTIMAL_VELOCITY, optimal_velocity


class OVM(DrivingModel):
    """Relaxes towards the optimal velocity of the gap.

    With s the bumper gap:

        V(s)  = v0 (tanh(s / width - beta) + tanh(beta)) / (1 + tanh(beta))     V = 0 for s < 0
        dv/dt = (V(s) - v) / tau
        v'    = max(0, v + dv/dt dt)

    At equilibrium the gap is `width (beta + artanh((1 + tanh(beta)) v / v0 - tanh(beta)))`. A
    platoon is string stable where `V'(s) <= 1 / (2 tau)`; with the defaults it is not, at medium
    gaps. The model does not use the leader's speed, so it reacts late and can collide.

    Differences from the paper: it has `V(h) = tanh(h - 2) + tanh(2)` without units, of the distance
    h between the vehicles' fronts, and the sensitivity 1 / tau. Here V is in SI units and depends
    on the bumper gap, so that speed and gap are 0 together; v0, width and beta can be chosen. The
    step is forward Euler in dt; the paper's model is continuous in time.

    Differences from SUMO: SUMO has no optimal-velocity model.
    """

    reference = "Bando et al. (1995), Phys. Rev. E 51(2); Treiber and Kesting (2013), section 10.6"
    parameters = ParameterSpace.of(
        *OPTIMAL_VELOCITY,
        Parameter(
            "tau",
            "s",
            0.2,
            20.0,
            0.65,
            "relaxation time",
            "default: Treiber and Kesting (2013), section 10.6;"
            " low: Euler steps of up to 0.2 s do not overshoot",
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        wanted = optimal_velocity(bumper_gap(follower, leader), p)
        return (follower.speed + (wanted - follower.speed) * (dt / p["tau"])).clamp(min=0.0)
