"""Wiedemann's 1974 model (`w74`): four regimes between perception thresholds.

R. Wiedemann (1974), *Simulation des Straßenverkehrsflusses*, Schriftenreihe des Instituts für
Verkehrswesen, Universität Karlsruhe, Heft 8: the thresholds and the regimes. R. Wiedemann and U.
Reiter (1992), *Microscopic traffic simulation: the simulation system MISSION, background and actual
state*, CEC Project ICARUS (V1052), final report, vol. 2, appendix A: the accelerations, as J.
Janson Olstam and A. Tapani (2004), *Comparison of car-following models*, VTI meddelande 960A,
restate them. The thresholds' form with five tuned parameters is that of Yang, Masuda and Tatsubori
(2021).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, Parameter, ParameterSpace, regimes

_NEAREST_ROOM = 1e-3
"""m: bounds quotients, and their gradients, beside a threshold; the brake cap acts long before."""

_VISSIM = (
    "default: PTV Vissim's Wiedemann 74 (ax 2 m, bx 2 + 3 z with z = 0.5); bounds: wide enough for"
    " drivers who stay far behind"
)
_REITER = "default: Wiedemann and Reiter (1992), the middle of the drivers; bounds: wide"


class W74(DrivingModel):
    """Drives freely, approaches, follows unconsciously or brakes hard, by what a driver perceives.

    With s the spacing front bumper to front bumper, L the leader's length, and `c = v - v_l` the
    **closing speed, positive when the follower is faster** (Wiedemann's sign; everywhere else in
    cfx the relative speed is `dv = v_l - v = -c`):

        AX   = L + ax_add                        spacing wanted at standstill
        BX   = bx_add sqrt(min(v, v_l))
        ABX  = AX + BX                           least spacing wanted while following
        SDX  = sdx_mult ABX                      spacing at which following ends
        SDV  = ((s - AX) / cx)^2                 closing speed that is just noticed; never negative
        OPDV = -opdv_add SDV                     the same for opening; never positive

    The first case that holds decides on the acceleration:

    1. *Emergency*, s <= ABX: `min(0, c^2 / (2 (AX - s)) + a_l + b_min (ABX - s) / BX)`, with c = 0
       where the gap opens; b_min where s <= AX.
    2. *Approaching*, c > SDV: `c^2 / (2 (ABX - s)) + a_l`: uniform braking that reaches ABX as the
       speeds become equal.
    3. *Following*, c > OPDV and s < SDX: `+b_null` if the last acceleration was positive, else
       `-b_null`. Free driving leads into this case accelerating and the two braking cases lead into
       it braking, so the last acceleration says which threshold was crossed.
    4. *Free*: `b_max (1 - v / v_desired)`.

    The result is kept between b_min and the free acceleration (or b_null, if that is larger), and
    the speed at 0 or above.

    Units: SDV is a speed, so cx is a length over the root of a speed, (m s)^0.5; so is bx_add.

    Differences from the paper: it drops the root in BX. Everything that Wiedemann draws at random
    for each driver and each decision (estimation errors, driver types) is at its mean, in the
    parameters.

    Differences from Wiedemann and Reiter: the paper's SDX is a multiple of ABX, theirs is AX + EX
    BX; their threshold CLDV for closing in while already following is SDV; there is no largest
    distance (150 m) for approaching; their FAKTORV is v_max / v_desired, so that v_max cancels out
    of the free acceleration, whose b_max is their BMAXmult v_max; an emergency counts the speed
    difference only where the gap closes, and never accelerates.

    Differences from SUMO's `Wiedemann`: that one has two parameters, security and estimation, which
    stand for ax_add = 1 + 2 security, bx_add = 1 + 7 security and cx = 25 (1 + security +
    estimation). Its BX takes the follower's own speed; it draws OPDV at random, ignores a_l,
    accelerates freely by another rule, and its b_null is a fifth of its largest acceleration.

    Not differentiable in the thresholds themselves: gradients are those of the case that holds;
    while following they are those of b_null alone. `at_temperature` makes them differentiable for
    training.
    """

    reference = (
        "Wiedemann (1974); Wiedemann and Reiter (1992); Janson Olstam and Tapani (2004), VTI"
        " meddelande 960A"
    )
    collision_free: ClassVar[bool] = True
    search_effort: ClassVar[float] = 3.0

    parameters = ParameterSpace.of(
        Parameter("ax_add", "m", 0.5, 10.0, 2.0, "gap at standstill", _VISSIM),
        Parameter(
            "bx_add",
            "(m s)^0.5",
            0.1,
            12.0,
            3.5,
            "growth of the least spacing with the root of speed",
            _VISSIM,
        ),
        Parameter(
            "sdx_mult",
            "1",
            1.05,
            4.0,
            1.5,
            "spacing at which following ends, as a multiple of ABX",
            _REITER,
        ),
        Parameter(
            "cx",
            "(m s)^0.5",
            10.0,
            120.0,
            50.0,
            "perception of speed differences; larger notices smaller ones",
            _REITER,
        ),
        Parameter(
            "opdv_add",
            "1",
            0.1,
            5.0,
            1.5,
            "how much larger an opening speed must be to be noticed",
            _REITER,
        ),
        Parameter(
            "b_max",
            "m/s2",
            0.5,
            6.0,
            2.6,
            "free acceleration from standstill",
            "SUMO's passenger car",
            tuned=False,
        ),
        Parameter(
            "v_desired",
            "m/s",
            5.0,
            70.0,
            33.3,
            "speed wanted on a free road",
            "120 km/h",
            tuned=False,
        ),
        Parameter(
            "b_null",
            "m/s2",
            0.01,
            1.0,
            0.25,
            "acceleration while following",
            "Vissim's CC7",
            tuned=False,
        ),
        Parameter(
            "b_min",
            "m/s2",
            -20.0,
            -1.0,
            -9.0,
            "hardest braking, negative",
            "SUMO's emergencyDecel",
            tuned=False,
        ),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        b_min, b_null = p["b_min"], p["b_null"]
        v, v_l, a_l = follower.speed, leader.speed, leader.acceleration
        s = leader.position - follower.position
        closing = v - v_l
        ax = leader.length + p["ax_add"]
        bx = p["bx_add"] * regimes.safe_sqrt(torch.minimum(v, v_l))
        abx = ax + bx
        sdx = p["sdx_mult"] * abx
        sdv = ((s - ax) / p["cx"]).square()
        opdv = -p["opdv_add"] * sdv

        free = p["b_max"] * (1.0 - v / p["v_desired"])
        following = torch.where(follower.acceleration > 0, b_null, -b_null)
        approaching = a_l - 0.5 * closing.square() / (s - abx).clamp(min=_NEAREST_ROOM)
        lack = ((abx - s) / bx.clamp(min=_NEAREST_ROOM)).clamp(0.0, 1.0)
        emergency = (
            a_l
            - 0.5 * closing.clamp(min=0.0).square() / (s - ax).clamp(min=_NEAREST_ROOM)
            + b_min * lack
        )
        emergency = torch.where(s <= ax, b_min, emergency.clamp(max=0.0))

        most = torch.maximum(free, b_null)
        if not regimes.switches_exactly(self.temperature):
            # They are mixed, so each must be something that the vehicle can do.
            approaching = approaching.maximum(b_min).minimum(most)
            emergency = emergency.maximum(b_min).minimum(most)
        # Nested, not joined by `&`, as in w99: masks of doubles are slow to join.
        near_by = partial(
            regimes.where_below, scale=regimes.SPACING_WIDTH, temperature=self.temperature
        )
        slower = partial(
            regimes.where_below, scale=regimes.SPEED_WIDTH, temperature=self.temperature
        )
        calm = slower(opdv, closing, near_by(s, sdx, following, free), free)
        calm = slower(sdv, closing, approaching, calm)
        acceleration = regimes.where_up_to(
            s, abx, emergency, calm, scale=regimes.SPACING_WIDTH, temperature=self.temperature
        )
        acceleration = torch.maximum(torch.minimum(acceleration, most), b_min)
        return (v + acceleration * dt).clamp(min=0.0)
