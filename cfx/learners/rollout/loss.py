"""The loss of trajectories: the job's objective, the gap's error beside it, and the jerk.

Shapes: N networks, D trajectories of each, K simulated frames.
"""

from __future__ import annotations

from torch import Tensor

from cfx.learners.rollout.base_errors import Divisors
from cfx.learners.rollout.loop import Segment
from cfx.learners.rollout.settings import LossSettings
from cfx.objectives.base import FrameValues, Objective
from cfx.objectives.rmse import GapRmse, SpeedRmse

_EPSILON = 1e-4
"""(m/s)2, m2: keeps the slope of a root finite where a trajectory has no error."""


class TrajectoryLoss:
    """The loss of each trajectory, without unit except for the jerk's term.

    Args:
        objective: of the job.
        settings: weights of the other terms.
        dt: time step, s.
    """

    def __init__(self, objective: Objective, settings: LossSettings, dt: float) -> None:
        self.objective = objective
        self.settings = settings
        self.dt = dt
        self.gap_rmse = GapRmse()
        self.speed_rmse = SpeedRmse()

    def __call__(self, segment: Segment, divisors: Divisors) -> Tensor:
        """Returns the loss of each trajectory over a segment, `(N, D)`.

        Where experts were asked, its value is the same, but its gradient is that of the difference
        to their speeds.
        """
        counted = segment.measured.counted
        values = self._values(segment, segment.measured.speed)
        objective = self.objective(values, counted, dim=-1, epsilon=_EPSILON)
        gap = self.gap_rmse(values, counted, dim=-1, epsilon=_EPSILON)
        loss = objective / divisors.objective + self.settings.gap_weight * (gap / divisors.gap)
        loss = loss + self.settings.jerk_weight * _rms_jerk(segment.speed, counted, self.dt)
        if segment.expert_speed is None:
            return loss
        values = self._values(segment, segment.expert_speed)
        difference = self.speed_rmse(values, counted, dim=-1, epsilon=_EPSILON)
        return loss.detach() + (difference - difference.detach())

    def _values(self, segment: Segment, speed: Tensor) -> FrameValues:
        """Returns what objectives compare with these speeds, m/s, and with the measured gap."""
        return FrameValues(
            speed=segment.speed,
            gap=segment.gap,
            measured_speed=speed,
            measured_gap=segment.measured.gap,
            dt=self.dt,
        )


def _rms_jerk(speeds: Tensor, counted: Tensor, dt: float) -> Tensor:
    """Returns the RMS jerk of each trajectory over the frames that count, m/s3, `(N, D)`."""
    jerk = speeds.diff(n=2, dim=-1) / (dt * dt)
    weight = counted[..., 2:]
    mean = (jerk.square() * weight).sum(-1) / weight.sum(-1).clamp(min=1.0)
    return (mean + _EPSILON).sqrt()
