"""The Intelligent Driver Model (`idm`).

M. Treiber, A. Hennecke and D. Helbing (2000), *Congested traffic states in empirical observations
and microscopic simulations*, Physical Review E 62(2), 1805-1824. M. Treiber and A. Kesting (2013),
*Traffic Flow Dynamics*, Springer, chapter 11.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.vtype import VType

_PAPER = (
    "default: Treiber et al. (2000), table I;"
    " bounds: about those of Kesting and Treiber (2008), Transp. Res. Rec. 2088"
)

CLOSEST = 0.1
"""Smallest gap, m: a smaller one counts as this, because the desired gap is divided by it."""

IDM_PARAMETERS = ParameterSpace.of(
    Parameter("v0", "m/s", 1.0, 70.0, 120 / 3.6, "desired speed on a free road", _PAPER),
    Parameter("T", "s", 0.1, 5.0, 1.6, "desired time gap", _PAPER),
    Parameter("s0", "m", 0.1, 8.0, 2.0, "gap at standstill", _PAPER),
    Parameter("a", "m/s2", 0.1, 6.0, 0.73, "maximum acceleration", _PAPER),
    Parameter("b", "m/s2", 0.1, 6.0, 1.67, "comfortable deceleration", _PAPER),
    Parameter(
        "delta",
        "1",
        1.0,
        8.0,
        4.0,
        "acceleration exponent",
        "Treiber et al. (2000), table I",
        tuned=False,
    ),
)


def desired_gap(v: Tensor, v_l: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """Returns s*, m: `s0 + max(0, v T + v (v - v_l) / (2 sqrt(a b)))`, of speeds in m/s."""
    dynamic = v * p["T"] + v * (v - v_l) / (2.0 * torch.sqrt(p["a"] * p["b"]))
    return p["s0"] + dynamic.clamp(min=0.0)


class IDM(DrivingModel):
    """Accelerates towards a desired speed and brakes as the gap falls below a desired one.

    With s the bumper gap, v the speed and v_l the leader's:

        s* = s0 + max(0, v T + v (v - v_l) / (2 sqrt(a b)))
        dv/dt = a (1 - (v / v0)^delta - (s* / s)^2)
        v' = max(0, v + dv/dt dt)

    At equilibrium (v = v_l < v0) the gap is `(s0 + v T) / sqrt(1 - (v / v0)^delta)`.

    Differences from the paper: the dynamic part of s* is never negative, as in Treiber and Kesting
    (2013); otherwise a leader who accelerates away would seem too close. s1 = 0, as in the paper's
    table. A gap below 0.1 m, or a negative one, counts as 0.1 m. The paper's model is continuous in
    time: here a step is forward Euler, of first order in dt.

    Differences from SUMO: with v0 = maxSpeed, T = tau, s0 = minGap, a = accel, b = decel it is
    SUMO's IDM wherever SUMO takes one sub-step, that is for steps up to 0.37 s unless its
    `stepping` is changed. Its limits are emergencyDecel and accel there, and `model.limits` here.
    SUMO also rounds speeds below 1e-5 m/s (at steps of 0.1 s) to 0, and the road's limit lowers v0.
    """

    reference = "Treiber, Hennecke and Helbing (2000), Phys. Rev. E 62(2)"
    collision_free = True
    parameters = IDM_PARAMETERS

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        names = {
            "v0": "maxSpeed",
            "T": "tau",
            "s0": "minGap",
            "a": "accel",
            "b": "decel",
            "delta": "delta",
        }
        attributes: dict[str, Tensor | str] = {}
        for ours, theirs in names.items():
            attributes[theirs] = p[ours]
        if self.limits is not None:
            attributes["emergencyDecel"] = repr(self.limits.emergency_deceleration)
        return VType("IDM", attributes)

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        v = follower.speed
        crowding = desired_gap(v, leader.speed, p) / bumper_gap(follower, leader).clamp(min=CLOSEST)
        acceleration = p["a"] * (1.0 - torch.pow(v / p["v0"], p["delta"]) - crowding * crowding)
        return (v + acceleration * dt).clamp(min=0.0)
