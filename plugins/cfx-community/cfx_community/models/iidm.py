"""The Improved Intelligent Driver Model (`iidm`).

M. Treiber and A. Kesting (2013), *Traffic Flow Dynamics: Data, Models and Simulation*, Springer,
section 11.3.7.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from cfx import get
from cfx.plugin import DrivingModel, Follower, Leader, bumper_gap

IDM = cast(type[DrivingModel], get("model", "idm"))

CLOSEST = 0.1
"""Smallest gap, m: a smaller one counts as this, because the desired gap is divided by it."""

_NEARLY_ZERO = 1e-6
"""m/s2: least free acceleration in the exponent that it divides."""


def desired_gap(v: Tensor, v_l: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """Returns s*, m: `s0 + max(0, v T + v (v - v_l) / (2 sqrt(a b)))`, of speeds in m/s."""
    dynamic = v * p["T"] + v * (v - v_l) / (2.0 * torch.sqrt(p["a"] * p["b"]))
    return p["s0"] + dynamic.clamp(min=0.0)


class IIDM(DrivingModel):
    """The Intelligent Driver Model with an equilibrium gap of exactly `s0 + v T`.

    Above the desired speed it brakes gently. With s* as in `idm` and z = s* / s:

        a_free = a (1 - (v / v0)^delta)               v <= v0
                 -b (1 - (v0 / v)^(a delta / b))      v > v0

        dv/dt  = a (1 - z^2)                          v <= v0, z >= 1
                 a_free (1 - z^(2 a / a_free))        v <= v0, z < 1
                 a_free + a (1 - z^2)                 v > v0, z >= 1
                 a_free                               v > v0, z < 1

        v'     = max(0, v + dv/dt dt)

    At equilibrium (v = v_l < v0) the gap is `s0 + v T`: the time gap is T at every speed, while in
    `idm` it grows without bound towards v0. On a free road the deceleration above v0 never exceeds
    b.

    Differences from the book: a gap below 0.1 m, or a negative one, counts as 0.1 m. Defaults and
    bounds are those of `idm`, so the two differ in their equations only.

    Differences from SUMO: its IDM is `idm`; it has no model with this acceleration function alone.
    """

    reference = "Treiber and Kesting (2013), Traffic Flow Dynamics, section 11.3.7"
    collision_free = True
    parameters = IDM.parameters

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        v, a, b, delta = follower.speed, p["a"], p["b"], p["delta"]
        z = desired_gap(v, leader.speed, p) / bumper_gap(follower, leader).clamp(min=CLOSEST)
        ratio = v / p["v0"]
        fast, crowded = ratio > 1.0, z >= 1.0

        # Bases are at most 1 also in the branch not chosen: values and gradients are finite.
        gaining = a * (1.0 - torch.pow(ratio.clamp(max=1.0), delta))
        losing = -b * (1.0 - torch.pow(ratio.clamp(min=1.0).reciprocal(), a * delta / b))
        approach = torch.pow(z.clamp(max=1.0), 2.0 * a / gaining.clamp(min=_NEARLY_ZERO))
        braking = a * (1.0 - z * z)

        below = torch.where(crowded, braking, gaining * (1.0 - approach))
        above = torch.where(crowded, losing + braking, losing)
        return (v + torch.where(fast, above, below) * dt).clamp(min=0.0)
