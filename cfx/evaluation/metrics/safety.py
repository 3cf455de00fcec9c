"""How safe and smooth a simulated trajectory is, and how its parameters are used.

Shapes: P pairs, K + 1 frames.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.evaluation.metrics.base import Metric, Trajectories
from cfx.evaluation.metrics.errors import masked_mean, root_mean_square

HARD_BRAKING = -8.0
"""m/s2: an acceleration below it is hard braking; tyres on a dry road give little more."""


class Collisions(Metric):
    """1 for a pair whose gap becomes negative, else 0."""

    unit = ""
    direction = "lower"
    summary = "sum"
    heading = "collisions"
    meaning = "pairs whose simulated gap becomes negative"
    scopes = ("test", "full_trajectory")
    order = 3

    def compute(self, trajectories: Trajectories) -> Tensor:
        collided = ((trajectories.gap < 0) & trajectories.counted).any(1)
        return collided.to(trajectories.gap.dtype)


class HardBraking(Metric):
    """Number of frames with an acceleration below -8 m/s2 (`HARD_BRAKING`)."""

    unit = "frames"
    direction = "lower"
    summary = "sum"
    heading = "hard braking"
    meaning = "frames with an acceleration below -8 m/s2"
    scopes = ("test", "full_trajectory")
    is_of_recording = True
    headline = False
    order = 21

    def compute(self, trajectories: Trajectories) -> Tensor:
        frames = hard_braking_frames(trajectories.speed, trajectories.counted, trajectories.dt)
        return frames.to(trajectories.speed.dtype)


class HardBrakingShare(Metric):
    """Share of the frames with an acceleration below -8 m/s2 (`HARD_BRAKING`)."""

    unit = ""
    direction = "lower"
    heading = "hard braking share"
    meaning = "share of the frames with an acceleration below -8 m/s2"
    is_of_recording = True
    headline = False
    order = 22

    def compute(self, trajectories: Trajectories) -> Tensor:
        counted = trajectories.counted
        frames = hard_braking_frames(trajectories.speed, counted, trajectories.dt)
        return frames.to(trajectories.speed.dtype) / counted[:, 1:].sum(1)


class AtLimits(Metric):
    """Share of the frames at a limit of acceleration (`model.limits`): there the guard steps in."""

    unit = ""
    direction = "lower"
    heading = "at limits"
    meaning = "share of the frames at a limit of acceleration, where the guard steps in"
    scopes = ("test", "full_trajectory")
    headline = False
    order = 25

    def compute(self, trajectories: Trajectories) -> Tensor:
        return _share(trajectories.at_limits, trajectories)


class OutsideRange(Metric):
    """Share of the frames outside what the policy has learned from (`cfx.policies.valid_range`)."""

    unit = ""
    direction = "lower"
    heading = "outside range"
    meaning = "share of the frames outside what the policy has learned from"
    scopes = ("test", "full_trajectory")
    headline = False
    order = 26

    def compute(self, trajectories: Trajectories) -> Tensor:
        return _share(trajectories.outside, trajectories)


class MinTtc(Metric):
    """Minimum time to collision: the least s / (v - v_leader) over the frames with v > v_leader.

    s is the gap, bumper to bumper. The time to collision is how long it would take both to meet at
    their present speeds (J. C. Hayward 1972, Near-miss determination through use of a scale of
    danger, Highway Research Record 384). It is 0 once the gap is closed, and not defined for a
    follower who is never faster than the leader.
    """

    unit = "s"
    direction = "higher"
    summary = "min"
    heading = "min TTC"
    meaning = "least time to collision at present speeds; of all pairs, the least"
    is_of_recording = True
    headline = False
    order = 23

    def compute(self, trajectories: Trajectories) -> Tensor:
        gap = trajectories.gap
        closing = trajectories.speed - trajectories.leader_speed
        met = gap <= 0
        defined = trajectories.counted & (met | (closing > 0))
        time = torch.where(met, 0.0, gap / torch.where(closing > 0, closing, 1.0))
        least = torch.where(defined, time, torch.inf).amin(1)
        return torch.where(defined.any(1), least, torch.nan)


def _share(marked: Tensor | None, trajectories: Trajectories) -> Tensor:
    """Returns the share of the frames that count which are marked; NaN where nobody looked."""
    counted = trajectories.counted
    if marked is None:
        return trajectories.speed.new_full((len(trajectories),), torch.nan)
    return (marked & counted).sum(1).to(trajectories.speed.dtype) / counted.sum(1)


def hard_braking_frames(speed: Tensor, counted: Tensor, dt: float) -> Tensor:
    """Counts frames with an acceleration below `HARD_BRAKING`.

    Args:
        speed: `(*batch, K + 1)`, m/s.
        counted: bool, broadcasting to it; the acceleration at a frame is the one on the way to it,
            so frame 0 has none.
        dt: time step, s.

    Returns:
        `(*batch,)` int64.
    """
    return ((speed.diff(dim=-1) / dt < HARD_BRAKING) & counted[..., 1:]).sum(-1)


class Jerk(Metric):
    """Root mean square jerk; NaN where fewer than two frames count.

    The jerk is the difference of successive accelerations over the time step. The acceleration at
    the start is the recorded driver's own and does not count: the jump from it is no act of the
    model.
    """

    unit = "m/s3"
    direction = "none"
    heading = "RMS jerk"
    meaning = "root mean square jerk; that of the recorded drivers says what is usual"
    is_of_recording = True
    headline = False
    order = 24

    def compute(self, trajectories: Trajectories) -> Tensor:
        counted = trajectories.counted
        jerk = trajectories.speed.diff(n=2, dim=-1) / trajectories.dt**2
        return root_mean_square(jerk, counted[:, 2:] & counted[:, 1:-1])


NEAR_BOUND = 0.01
"""A value is at a bound within this share of the parameter's range."""


class AtBounds(Metric):
    """Share of the tuned parameters' values within 1 % of their range of a bound (`NEAR_BOUND`).

    A policy that drives at its bounds would like to leave them.
    """

    unit = ""
    direction = "none"
    heading = "at bounds"
    meaning = "share of the tuned parameters' values within 1 % of their range of a bound"
    headline = False
    order = 31

    def compute(self, trajectories: Trajectories) -> Tensor:
        unit = trajectories.space.to_unit(trajectories.parameters)
        at_bound = (unit <= NEAR_BOUND) | (unit >= 1 - NEAR_BOUND)
        return masked_mean(at_bound.double().mean(-1), trajectories.counted)
