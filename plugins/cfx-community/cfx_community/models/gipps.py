"""Gipps's model (`gipps`).

P. G. Gipps (1981), *A behavioural car-following model for computer simulation*, Transportation
Research Part B 15(2), 105-111.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace
from cfx_community.models.delay import Perception, perceive

_PAPER = "default: the mean driver of Gipps (1981); bounds: wide around it"

GIPPS_PARAMETERS = ParameterSpace.of(
    Parameter("tau", "s", 0.3, 5.0, 2 / 3, "apparent reaction time", _PAPER),
    Parameter("V", "m/s", 1.0, 70.0, 20.0, "desired speed on a free road", _PAPER),
    Parameter("a", "m/s2", 0.1, 6.0, 1.7, "greatest acceleration that the driver wishes", _PAPER),
    Parameter("b", "m/s2", 0.5, 9.0, 3.4, "hardest braking that the driver wishes", _PAPER),
    Parameter(
        "b_hat", "m/s2", 0.5, 9.0, 3.2, "braking that the driver expects of the leader", _PAPER
    ),
    Parameter(
        "s0",
        "m",
        0.0,
        8.0,
        2.0,
        "gap at standstill",
        "default: size of 6.5 m in Gipps (1981) less a 4.5 m car",
    ),
)


def intended_speed(seen: Perception, p: Mapping[str, Tensor]) -> Tensor:
    """Returns the speed that the driver chooses for one tau later, m/s; it may be negative.

    It is the smaller one of Gipps's v_free and v_safe.
    """
    v, tau, b = seen.speed, p["tau"], p["b"]
    ratio = v / p["V"]
    free = v + 2.5 * p["a"] * tau * (1.0 - ratio) * torch.sqrt(0.025 + ratio)
    room = 2.0 * (seen.gap - p["s0"]) - v * tau + seen.leader_speed * seen.leader_speed / p["b_hat"]
    radicand = b * b * tau * tau + b * room
    # The root of 1 stands in for the root of a negative number, whose gradient is not a number.
    possible = radicand > 0.0
    root = torch.sqrt(torch.where(possible, radicand, 1.0))
    safe = torch.where(possible, root, 0.0) - b * tau
    return torch.minimum(free, safe)


class Gipps(DrivingModel):
    """Takes the lower of two speeds: the desired one, and the highest one that is still safe.

    A speed is safe if the driver can stop behind the leader after a reaction time and half a
    reaction time in reserve. With g the bumper gap and b, b_hat positive decelerations, the speeds
    one reaction time tau later are

        v_free = v + 2.5 a tau (1 - v / V) sqrt(0.025 + v / V)
        v_safe = -b tau + sqrt(b^2 tau^2 + b (2 (g - s0) - v tau + v_l^2 / b_hat))

    and the driver moves towards the smaller one:

        v' = max(0, v + (min(v_free, v_safe) - v) min(1, dt / tau))

    At equilibrium (v = v_l < V) the gap is `s0 + 1.5 v tau + v^2 (1 / b - 1 / b_hat) / 2`.

    Differences from the paper: the paper's time step *is* tau (2/3 s), and speed changes linearly
    in between. A shorter step here covers the share dt / tau of the change to the paper's next
    speed; then the driver decides anew. So `dt = tau` gives the paper's speeds to the last digit. A
    shorter step has the paper's accelerations and equilibria, and tau acts as a relaxation time
    instead of a delay (`gipps_delay` has the delay). The paper's argument for safety is about steps
    of tau; that shorter steps are free of collisions too is tested, not proven. Positions are the
    simulation's Euler sums, the paper's are trapezoidal. The paper's effective size is the leader's
    length plus s0. A negative radicand (the gap is gone) gives v_safe = -b tau, hence hard braking.

    Differences from SUMO: SUMO has no Gipps model; its Krauss models descend from it.
    """

    reference = "Gipps (1981), Transp. Res. B 15(2)"
    collision_free = True
    parameters = GIPPS_PARAMETERS

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        v = follower.speed
        share = (dt / p["tau"]).clamp(max=1.0)
        change = intended_speed(perceive(follower, leader), p) - v
        return (v + change * share).clamp(min=0.0)
