"""The loss of trajectories: the job's objective, the gap's error beside it, and the jerk.

Shapes: N networks, D trajectories of each, K simulated frames.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cfx.learners.rollout.base_errors import Divisors
from cfx.learners.rollout.loop import Segment
from cfx.learners.rollout.settings import LossSettings
from cfx.objectives.base import FrameValues, Objective
from cfx.objectives.rmse import GapRmse, SpeedRmse

_EPSILON = 1e-4
"""(m/s)2, m2: keeps the slope of a root finite where a trajectory has no error."""


_LEAST_ERROR = 0.1
"""Share of the mean error that an error counts as at least, in weights of frames: in the first
frames after the start nothing can be wrong."""


class FrameWeights(NamedTuple):
    """How much each frame after the start counts, `(N, 1, K)` each, 1 in the mean error.

    Frames after the last count as the last.

    Attributes:
        speed: weight of what the objective adds up.
        gap: weight of squared errors of the gap.
    """

    speed: Tensor
    gap: Tensor

    @classmethod
    def relative_to(cls, speed_error: Tensor, gap_error: Tensor) -> FrameWeights:
        """Returns weights that let each frame count alike relative to these errors.

        Args:
            speed_error: of each network, mean square at each frame, `(N, 1, K)`, (m/s)2.
            gap_error: the same, m2.
        """
        return cls(_relative(speed_error), _relative(gap_error))

    def at(self, first: int, count: int) -> FrameWeights:
        """Returns the weights of `count` frames from frame `first` on."""
        index = torch.arange(first, first + count, device=self.speed.device)
        index = index.clamp(max=self.speed.shape[-1] - 1)
        return FrameWeights(self.speed[..., index], self.gap[..., index])


def _relative(error: Tensor) -> Tensor:
    mean = error.mean(-1, keepdim=True)
    return mean / error.clamp(min=_LEAST_ERROR**2 * mean)


class TrajectoryLoss:
    """The loss of each trajectory, without unit except for the jerk's term.

    Args:
        objective: of the job.
        settings: weights of the other terms.
        dt: time step, s.

    Attributes:
        frame_weights: how much each frame counts; None: all count alike.
    """

    def __init__(self, objective: Objective, settings: LossSettings, dt: float) -> None:
        self.frame_weights: FrameWeights | None = None
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
        weights = None
        if self.frame_weights is not None:
            weights = self.frame_weights.at(segment.first, counted.shape[-1])
        objective = _loss(self.objective, values, counted, weights and weights.speed)
        gap = _loss(self.gap_rmse, values, counted, weights and weights.gap)
        loss = objective / divisors.objective + self.settings.gap_weight * (gap / divisors.gap)
        loss = loss + self.settings.jerk_weight * _rms_jerk(segment.speed, counted, self.dt)
        if segment.expert_speed is None:
            return loss
        values = self._values(segment, segment.expert_speed)
        difference = _loss(self.speed_rmse, values, counted, weights and weights.speed)
        return loss.detach() + (difference - difference.detach())

    def of_paths(self, segment: Segment, divisors: Divisors, paths: int) -> Tensor:
        """Returns the CRPS of sampled paths over a segment, `(N, D)`, in the loss's terms.

        It is the mean over frames of the CRPS of speed, plus `gap_weight` times that of the gap,
        each with the divisors and the square roots of the weights of `__call__`. The estimator is
        fair: with one neighbour of each path it has the mean that all pairs of paths have (C. A. T.
        Ferro, 2014, *Fair scores for ensemble forecasts*, Q. J. R. Meteorol. Soc. 140).

        Args:
            segment: `(N, paths D, frames)`, each path of all trajectories behind the one before.
            divisors: of the trajectories, `(N, D)` each.
            paths: sampled of each trajectory, at least 2.
        """
        weights = None
        if self.frame_weights is not None:
            weights = self.frame_weights.at(segment.first, segment.speed.shape[-1])
        measured = segment.measured
        terms = []
        for signal, truth, weight, divisor in (
            (segment.speed, measured.speed, weights and weights.speed, divisors.objective),
            (segment.gap, measured.gap, weights and weights.gap, divisors.gap),
        ):
            score = _fair_crps(_paths(signal, paths), _paths(truth, paths))
            if weight is not None:
                score = score * weight.sqrt()
            counted = _paths(measured.counted, paths)[:, 0]
            mean = (score * counted).sum(-1) / counted.sum(-1).clamp(min=1)
            terms.append(mean / divisor)
        jerk = _rms_jerk(segment.speed, measured.counted, self.dt)
        loss = terms[0] + self.settings.gap_weight * terms[1]
        return loss + self.settings.jerk_weight * _paths(jerk[..., None], paths)[..., 0].mean(1)

    def _values(self, segment: Segment, speed: Tensor) -> FrameValues:
        """Returns what objectives compare with these speeds, m/s, and with the measured gap."""
        return FrameValues(
            speed=segment.speed,
            gap=segment.gap,
            measured_speed=speed,
            measured_gap=segment.measured.gap,
            dt=self.dt,
        )


def _loss(
    objective: Objective, values: FrameValues, counted: Tensor, weight: Tensor | None
) -> Tensor:
    """Returns an objective of trajectories, `(N, D)`, whose frames have a weight `(N, 1, K)`."""
    if weight is None:
        return objective(values, counted, dim=-1, epsilon=_EPSILON)
    sums = objective.sums(values, counted * weight, dim=-1)
    return objective.finish(sums, counted.sum(-1).clamp(min=1), _EPSILON)


def _paths(values: Tensor, paths: int) -> Tensor:
    """Returns `(N, paths D, K)` as `(N, paths, D, K)`."""
    return values.view(len(values), paths, -1, values.shape[-1])


def _fair_crps(sampled: Tensor, truth: Tensor) -> Tensor:
    """Returns the CRPS of each frame, `(N, D, K)`, of paths `(N, paths, D, K)`."""
    error = (sampled - truth).abs().mean(1)
    return error - 0.5 * (sampled - sampled.roll(1, 1)).abs().mean(1)


def _rms_jerk(speeds: Tensor, counted: Tensor, dt: float) -> Tensor:
    """Returns the RMS jerk of each trajectory over the frames that count, m/s3, `(N, D)`."""
    jerk = speeds.diff(n=2, dim=-1) / (dt * dt)
    weight = counted[..., 2:]
    mean = (jerk.square() * weight).sum(-1) / weight.sum(-1).clamp(min=1.0)
    return (mean + _EPSILON).sqrt()
