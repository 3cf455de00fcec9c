"""The inputs of policies that follow from the motion of follower and leader."""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.data.signals import SIGNALS
from cfx.policies.history import History
from cfx.policies.inputs.base import PolicyInput

_SLOWEST_MPS = 1.0
"""Slower followers count as this fast in the time headway, which has a pole at standstill."""

_NEAREST_M = 1.0
"""Smaller gaps count as this in the inverse time to collision, which has a pole at 0."""

_FRAME_S = 0.1
"""Time between frames for which jerk is in m/s3; a network's scaler takes out what differs."""


class LeaderSpeed(PolicyInput):
    """The leader's speed."""

    unit = "m/s"
    meaning = "speed of the leader"
    signals = (SIGNALS["leader_speed"],)

    def values(self, history: History) -> Tensor:
        return history["leader_speed"]


class LeaderAcceleration(PolicyInput):
    """The leader's acceleration."""

    unit = "m/s2"
    meaning = "acceleration of the leader"
    signals = (SIGNALS["leader_acceleration"],)

    def values(self, history: History) -> Tensor:
        return history["leader_acceleration"]


class FollowerSpeed(PolicyInput):
    """The follower's own speed."""

    unit = "m/s"
    meaning = "speed of the follower"
    signals = (SIGNALS["follower_speed"],)

    def values(self, history: History) -> Tensor:
        return history["follower_speed"]


class FollowerAcceleration(PolicyInput):
    """The follower's own acceleration."""

    unit = "m/s2"
    meaning = "acceleration of the follower"
    signals = (SIGNALS["follower_acceleration"],)

    def values(self, history: History) -> Tensor:
        return history["follower_acceleration"]


class Gap(PolicyInput):
    """The gap to the leader."""

    unit = "m"
    meaning = "gap to the leader, bumper to bumper"
    signals = (SIGNALS["gap"],)

    def values(self, history: History) -> Tensor:
        return history["gap"]


class RelativeSpeed(PolicyInput):
    """The rate at which the gap grows."""

    unit = "m/s"
    meaning = "speed of the leader minus that of the follower"
    signals = (SIGNALS["leader_speed"], SIGNALS["follower_speed"])

    def values(self, history: History) -> Tensor:
        return history["leader_speed"] - history["follower_speed"]


class TimeHeadway(PolicyInput):
    """The time in which the follower covers the gap at their present speed."""

    unit = "s"
    meaning = "gap over the follower's speed, which counts as 1 m/s at least"
    signals = (SIGNALS["gap"], SIGNALS["follower_speed"])

    def values(self, history: History) -> Tensor:
        return history["gap"] / history["follower_speed"].clamp(min=_SLOWEST_MPS)


class InverseTimeToCollision(PolicyInput):
    """The rate at which the gap shrinks, over the gap: 0 where speeds are the same."""

    unit = "1/s"
    meaning = "closing speed over the gap, which counts as 1 m at least"
    signals = (SIGNALS["follower_speed"], SIGNALS["leader_speed"], SIGNALS["gap"])

    def values(self, history: History) -> Tensor:
        closing = history["follower_speed"] - history["leader_speed"]
        return closing / history["gap"].clamp(min=_NEAREST_M)


class FollowerJerk(PolicyInput):
    """The change of the follower's acceleration from frame to frame."""

    unit = "m/s3"
    meaning = "jerk of the follower, at frames 0.1 s apart"
    signals = (SIGNALS["follower_acceleration"],)

    def values(self, history: History) -> Tensor:
        return _jerk(history["follower_acceleration"])


class LeaderJerk(PolicyInput):
    """The change of the leader's acceleration from frame to frame."""

    unit = "m/s3"
    meaning = "jerk of the leader, at frames 0.1 s apart"
    signals = (SIGNALS["leader_acceleration"],)

    def values(self, history: History) -> Tensor:
        return _jerk(history["leader_acceleration"])


def _jerk(acceleration: Tensor) -> Tensor:
    """Returns jerks `(*batch, L)`; the first stands twice, and is 0 where it is alone."""
    if acceleration.shape[-1] == 1:
        return torch.zeros_like(acceleration)
    difference = acceleration.diff(dim=-1)
    return torch.cat([difference[..., :1], difference], -1) / _FRAME_S
