"""Where a rollout begins, and what it gives."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Start(NamedTuple):
    """A follower's state when a rollout begins; all tensors `(*batch,)`.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        acceleration: m/s2.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor


class Trajectory(NamedTuple):
    """What a rollout gives; all tensors `(*batch, time)`, frame 0 being the start.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        gap: bumper to bumper, m; negative from a collision on.
        collided: bool, the gap is negative. A rollout goes on after a collision: nothing is hidden.
            False where the gap is NaN.
    """

    position: Tensor
    speed: Tensor
    gap: Tensor
    collided: Tensor
