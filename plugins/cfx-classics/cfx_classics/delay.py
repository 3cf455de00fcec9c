"""Delayed perception: a driving model's memory of what its driver saw in the last frames.

A model with a reaction time acts on what its driver saw some time ago. These functions keep the
last K frames of the perceived gap and speeds in `Follower.memory` and read them back at any delay,
by linear interpolation between frames: M. Treiber, A. Kesting and D. Helbing (2006), *Delays,
inaccuracies and anticipation in microscopic traffic models*, Physica A 360(1), 71-88, section 2.1.

Shapes: `*batch` as in `cfx.DrivingModel`; K frames; m = `memory_width(K)`, the width of the memory.
The memory holds the number of frames seen so far, then K gaps, K speeds and K leader speeds, the
latest first. All zeros is the memory of a driver who has seen nothing; whoever has seen fewer than
K frames is taken to have seen the first one ever since.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cfx import Follower, Leader, bumper_gap


class Perception(NamedTuple):
    """What a driver sees in one frame; all tensors `(*batch,)`.

    Attributes:
        gap: bumper to bumper, m.
        speed: their own, m/s.
        leader_speed: m/s.
    """

    gap: Tensor
    speed: Tensor
    leader_speed: Tensor


def memory_width(frames: int) -> int:
    """Returns m, the width of a memory of so many frames."""
    return 1 + len(Perception._fields) * frames


def perceive(follower: Follower, leader: Leader) -> Perception:
    """Returns what the driver sees now."""
    speed = follower.speed
    gap = bumper_gap(follower, leader)
    return Perception(gap.expand_as(speed), speed, leader.speed.expand_as(speed))


def remember(memory: Tensor, seen: Perception) -> Tensor:
    """Returns the memory `(*batch, m)` with one frame more; the oldest frame is forgotten."""
    count = memory[..., :1]
    now = torch.stack(seen, dim=-1)[..., None]
    past = _past(memory, now)
    frames = torch.cat([now, past[..., :-1]], dim=-1)
    return torch.cat([count + 1.0, frames.flatten(-2)], dim=-1)


def recall(memory: Tensor, seen: Perception, delay: Tensor) -> Perception:
    """Returns what the driver saw `delay` frames ago.

    Args:
        memory: `(*batch, m)`, of the frames before this one.
        seen: this frame, which is what the driver saw 0 frames ago.
        delay: in frames, not necessarily a whole number, broadcasting to `(*batch,)`; a delay
            beyond the memory reads its oldest frame.
    """
    now = torch.stack(seen, dim=-1)[..., None]
    frames = torch.cat([now, _past(memory, now)], dim=-1)
    oldest = frames.shape[-1] - 1
    bounded = delay.expand_as(seen.speed).clamp(0.0, float(oldest))
    # An index must be a number; where the delay is none, `share` still carries the NaN on.
    later = torch.nan_to_num(bounded.detach()).floor().clamp(max=float(oldest - 1))
    share = (bounded - later)[..., None]
    index = later.long()[..., None, None].expand(*now.shape)
    start = frames.gather(-1, index)[..., 0]
    end = frames.gather(-1, index + 1)[..., 0]
    gap, speed, leader_speed = (start + (end - start) * share).unbind(dim=-1)
    return Perception(gap, speed, leader_speed)


def frames_seen(memory: Tensor) -> Tensor:
    """Returns how many frames the driver has seen before this one, `(*batch,)`."""
    return memory[..., 0]


def _past(memory: Tensor, now: Tensor) -> Tensor:
    """Returns the remembered frames `(*batch, 3, K)`; the present `(*batch, 3, 1)` if none are."""
    stored = memory[..., 1:].reshape(*memory.shape[:-1], len(Perception._fields), -1)
    nothing_seen = frames_seen(memory)[..., None, None] == 0.0
    return torch.where(nothing_seen, now, stored)
