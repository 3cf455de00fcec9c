"""Delayed perception: a driving model's memory of what its driver saw in the last frames.

A model with a reaction time acts on what its driver saw some time ago. These functions keep the
last K frames of the perceived gap and speeds in `Follower.memory` and read them back at any delay,
by linear interpolation between frames: M. Treiber, A. Kesting and D. Helbing (2006), *Delays,
inaccuracies and anticipation in microscopic traffic models*, Physica A 360(1), 71-88, section 2.1.

Shapes: `*batch` as in `cfx.plugin.DrivingModel`; K frames; m = `memory_width(K)`, the width of the
memory. The memory holds the number of frames seen so far, then gap, speed and leader speed of each
frame, the latest first. All zeros is the memory of a driver who has seen nothing. A driver who has
seen fewer frames than they want to recall gets the first one they saw.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cfx.plugin import Follower, Leader, bumper_gap


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


_SIGNALS = len(Perception._fields)


def memory_width(frames: int) -> int:
    """Returns m, the width of a memory of so many frames."""
    return 1 + _SIGNALS * frames


def perceive(follower: Follower, leader: Leader) -> Perception:
    """Returns what the driver sees now."""
    speed = follower.speed
    gap = bumper_gap(follower, leader)
    return Perception(gap.expand_as(speed), speed, leader.speed.expand_as(speed))


def remember(memory: Tensor, seen: Perception) -> Tensor:
    """Returns the memory `(*batch, m)` with one frame more; the oldest frame is forgotten."""
    count = memory[..., :1] + 1.0
    return torch.cat([count, torch.stack(seen, dim=-1), memory[..., 1:-_SIGNALS]], dim=-1)


def recall(memory: Tensor, seen: Perception, delay: Tensor) -> Perception:
    """Returns what the driver saw `delay` frames ago.

    Args:
        memory: `(*batch, m)`, of the frames before this one.
        seen: this frame, which is what the driver saw 0 frames ago.
        delay: in frames, not necessarily a whole number, broadcasting to `(*batch,)`; a delay
            beyond the memory reads its oldest frame.
    """
    capacity = (memory.shape[-1] - 1) // _SIGNALS
    oldest = frames_seen(memory).clamp(max=float(capacity))
    bounded = torch.minimum(delay.clamp(min=0.0), oldest)
    # An index must be a number; where the delay is NaN, `share` passes it on.
    later = torch.nan_to_num(bounded.detach()).floor()
    earlier = torch.minimum(later + 1.0, oldest)
    now = torch.stack(seen, dim=-1)
    start = _frame(memory, now, later)
    end = _frame(memory, now, earlier)
    share = (bounded - later)[..., None]
    gap, speed, leader_speed = (start + (end - start) * share).unbind(dim=-1)
    return Perception(gap, speed, leader_speed)


def frames_seen(memory: Tensor) -> Tensor:
    """Returns how many frames the driver has seen before this one, `(*batch,)`."""
    return memory[..., 0]


def _frame(memory: Tensor, now: Tensor, number: Tensor) -> Tensor:
    """Returns the signals `(*batch, 3)` of the frame `number`, `(*batch,)`, counted backwards."""
    first = 1 + _SIGNALS * (number.long() - 1).clamp(min=0)
    columns = first[..., None] + torch.arange(_SIGNALS, device=memory.device)
    remembered = memory.gather(-1, columns)
    return torch.where(number[..., None] == 0.0, now, remembered)
