"""The loss of trajectories: the job's objective, the gap's error beside it, and the jerk.

A trajectory's loss is divided by the error of its constant base parameters (`BaseErrors`): the
improvement over these is what an evaluation reports, and some trajectories are much harder to
follow than others.

Shapes: U recorded pairs, N networks (each member of an ensemble counts), B drivers of the network
that has most, D trajectories of each network, K simulated frames, W windows of the longest pair, n
parameters that bases have, R pairs with a base each, C most bases of one pair, F first frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.objectives import FrameValues, Objective
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.learners.base import TrainingData
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.settings import LossSettings
from cfx.learners.rollout.window import Segment

_AT_ONCE = 1_000_000
"""Frames of all segments that are simulated at once, which bounds the memory to some 100 MB."""

_LEAST_GAP = 1.0
"""m: added to the gap's error of the base, as the objective's floor is to the objective's:
otherwise trajectories that the base follows well would outweigh all others."""

_LEAST_DIVISOR = 1e-6
"""Divisor at least, for an objective without a floor."""


class Divisors(NamedTuple):
    """Divisors of the terms of each trajectory's loss, `(N, D)` each.

    Attributes:
        objective: in the objective's unit.
        gap: m.
    """

    objective: Tensor
    gap: Tensor


@dataclass(frozen=True)
class BaseErrors:
    """The objective and the gap's RMSE of constant parameters, side by side in the last dimension.

    Networks share pairs, and often bases too: each pair is simulated once with each of its bases.

    Attributes:
        over_windows: over the horizon from each window on, `(R, W, 2)`.
        over_pair: over the whole training part, `(R, 2)`; of pooled bases alone.
        driver_row: of each place's driver with their base, `(N, B)`.
        pooled_row: with the base of drivers without one of their own.
        objective: the job's.
    """

    over_windows: Tensor
    over_pair: Tensor
    driver_row: Tensor
    pooled_row: Tensor
    objective: Objective

    @classmethod
    def of(cls, training_data: TrainingData, dataset: RolloutDataset, horizon: int) -> BaseErrors:
        """Simulates the bases, in the precision of the training data; `horizon` in windows."""
        networks, drivers = dataset.pair.shape
        base = dataset.base
        pooled = dataset.pooled[:, None].expand(-1, drivers, -1)
        if training_data.pairs.base is None:
            pooled = base
        # Rows (pair, base) of all places, with each driver's base and with the pooled one: (N, 2 B,
        # 1 + n). Those that are equal are simulated once.
        pair = torch.cat([dataset.pair, dataset.pair], 1)[..., None].to(base.dtype)
        pairs_and_bases = torch.cat([pair, torch.cat([base, pooled], 1)], -1)
        rows, row = torch.unique(pairs_and_bases.flatten(0, 1), dim=0, return_inverse=True)
        row = row.view(networks, 2 * drivers)
        pair, unit = rows[:, 0].long(), rows[:, 1:]
        count = torch.bincount(pair, minlength=len(dataset.recordings.batch))
        first = count.cumsum(0) - count
        place = torch.arange(len(pair), device=pair.device) - first[pair]
        number = torch.arange(int(count.max()), device=pair.device)
        # A pair with fewer bases than another has one of them several times.
        bases = unit[first[:, None] + torch.minimum(number, count[:, None] - 1)]
        stride = training_data.windows.stride
        frames = torch.arange(dataset.recordings.tokens.shape[1], device=base.device) * stride
        over_windows = _errors(training_data, dataset, bases, frames, horizon * stride)
        over_pair = _errors(training_data, dataset, bases, frames[:1], int(dataset.last.max()))
        return cls(
            over_windows[pair, :, place],
            over_pair[pair, 0, place],
            row[:, :drivers],
            row[:, drivers:],
            training_data.objective,
        )

    def only(self, networks: slice) -> BaseErrors:
        """Returns the errors of some networks."""
        used = torch.cat([self.driver_row[networks], self.pooled_row[networks]], 1)
        rows, row = torch.unique(used, return_inverse=True)
        drivers = self.driver_row.shape[1]
        return replace(
            self,
            over_windows=self.over_windows[rows],
            over_pair=self.over_pair[rows],
            driver_row=row[:, :drivers],
            pooled_row=row[:, drivers:],
        )

    def over_horizon(self, batch: RolloutBatch) -> Divisors:
        """Returns the divisors over the horizon from where each trajectory begins."""
        driver_row = self.driver_row[batch.row, batch.place]
        pooled_row = self.pooled_row[batch.row, batch.place]
        row = torch.where(batch.cold_start, pooled_row, driver_row)
        return self._divisors(self.over_windows[row, batch.start], batch)

    def over_full_trajectory(self, batch: RolloutBatch) -> Divisors:
        """Returns the divisors over each trajectory from the first frame to the last."""
        return self._divisors(self.over_pair[self.pooled_row[batch.row, batch.place]], batch)

    def _divisors(self, errors: Tensor, batch: RolloutBatch) -> Divisors:
        """Takes the errors `(N, D, 2)` of unscaled trajectories."""
        objective, gap = errors[..., 0], errors[..., 1]
        if batch.scale is not None:
            gap = gap * batch.scale
            # An objective with a unit grows with the trajectories' scale.
            if self.objective.unit:
                objective = objective * batch.scale
        objective = (objective + self.objective.floor).clamp(min=_LEAST_DIVISOR)
        return Divisors(objective, gap + _LEAST_GAP)


@torch.no_grad()
def _errors(
    training_data: TrainingData, dataset: RolloutDataset, bases: Tensor, frames: Tensor, steps: int
) -> Tensor:
    """Simulates all bases of all pairs from some frames on.

    Args:
        training_data: the recordings, and what simulates.
        dataset: which of them are learned from.
        bases: of each pair, in unit space, `(U, C, n)`.
        frames: at which trajectories begin, `(F,)`.
        steps: how many each lasts at most.

    Returns:
        The objective and the gap's RMSE, `(U, F, C, 2)`, in single precision.
    """
    stepper, rows = training_data.stepper, dataset.recordings.pair
    recorded = training_data.pairs.index[rows]
    last = training_data.pairs.split.frame.to(rows.device)[rows]
    # What heads answer beyond the model's parameters stands behind them, and is left out.
    space = stepper.model.adaptation_space
    bases = bases[..., : len(space)]
    # Whether a kernel pays is asked for all shards together.
    stepper = stepper.for_work(len(last) * len(frames) * steps * bases.shape[1])
    size = max(1, _AT_ONCE // (len(frames) * steps))
    errors = []
    for start in range(0, len(last), size):
        shard = slice(start, start + size)
        count, batch = len(last[shard]), training_data.recorded[recorded[shard]]
        # Each pair from each of the frames on, (count F,).
        pair = torch.arange(count, device=rows.device).repeat_interleave(len(frames))
        first = frames.repeat(count)
        losses = SegmentLosses.of_segments(
            stepper,
            training_data.objective,
            batch,
            pair,
            first.clamp(max=batch.mask.shape[1] - 1),
            (last[shard][pair] - first).clamp(0, steps),
        )
        unit = bases[shard].to(losses.segments.counted.dtype)
        values = space.from_unit(unit).repeat_interleave(len(frames), 0)
        p = {name: value.contiguous() for name, value in space.unpack(values).items()}
        of_shard = torch.stack([losses(p), replace(losses, objective=GapRmse())(p)], -1)
        errors.append(of_shard.view(count, len(frames), -1, 2).float())
    return torch.cat(errors)


_EPSILON = 1e-4
"""(m/s)2, m2: keeps the slope of a root finite where a trajectory has no error."""


_LEAST_ERROR = 0.1
"""Share of the mean error that an error counts as at least, in weights of frames: in the first
frames after the start nothing can be wrong."""


class FrameWeights(NamedTuple):
    """Weight of each frame after the start, `(N, 1, K)` each, 1 in the mean error.

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
