"""How hard live vehicles brake: comfortably, unless keeping their `minGap` needs more.

Shapes: D vehicles.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.plugin import LimitSettings
from cfx_sumo.live.surroundings import Seen

_MARGIN = 1.5
"""How much harder than needed a vehicle may brake: it cannot know what its leader does next."""

_NEAR_M = 0.2
"""Room to brake in counts as this at least, m."""


def needed_deceleration(seen: Seen) -> Tensor:
    """Returns how hard vehicles must brake at least to keep their `minGap` behind their leaders.

    The leader goes on as it is, or brakes on to a standstill: the harder of both counts. With the
    room s, which is the gap less `minGap` (for SUMO a shorter gap is a collision, and where its own
    models end), the speeds v and v_l and the leader's deceleration b_l,

        b = (v - v_l)^2 / (2 s)  if v > v_l        b = v^2 / (2 (s + v_l^2 / (2 b_l)))

    Returns:
        `(D,)`, m/s2, not negative.
    """
    room = (seen.gap - seen.min_gap).clamp(min=_NEAR_M)
    closing = (seen.speed - seen.leader_speed).clamp(min=0.0)
    steady = closing.square() / (2.0 * room)
    braking = (-seen.leader_acceleration).clamp(min=0.0)
    path = seen.leader_speed.square() / (2.0 * braking.clamp(min=1e-3))
    stopping = torch.where(braking > 0, seen.speed.square() / (2.0 * (room + path)), 0.0)
    return torch.maximum(steady, stopping)


def hardest_braking(seen: Seen, limits: LimitSettings) -> Tensor:
    """Returns how hard vehicles may brake now, `(D,)`, m/s2.

    That is comfortably, or harder where `needed_deceleration` is, but never harder than in an
    emergency.
    """
    needed = _MARGIN * needed_deceleration(seen)
    return needed.clamp(limits.comfortable_deceleration, limits.emergency_deceleration)
