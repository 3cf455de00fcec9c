"""The errors of constant base parameters, which a trajectory's loss is divided by.

The improvement over constant parameters is what an evaluation reports, and some trajectories are
much harder to follow than others.

Shapes: P pairs, N networks (each member of an ensemble counts), B drivers of the network that has
most, D trajectories of each network, W windows of the longest pair, n tuned parameters, K simulated
frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.learners.base import TrainingData
from cfx.learners.rollout.batch import RolloutBatch
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.models.base import Leader
from cfx.objectives.base import FrameValues
from cfx.objectives.rmse import GapRmse
from cfx.pairs import PairBatch
from cfx.simulation.trajectory import Start

_TABLE = 4_000_000
"""Vehicle steps of one part of a table of errors, which bounds its memory to some hundred MB."""

_LEAST_GAP = 1.0
"""m: added to the gap's error of the base, as the objective's floor is to the objective's:
otherwise
trajectories that the base follows well would outweigh all others."""

_LEAST_DIVISOR = 1e-6
"""Divisor at least, for an objective without a floor."""


class Divisors(NamedTuple):
    """What the terms of each trajectory's loss are divided by, `(N, D)` each.

    Attributes:
        objective: in the objective's unit.
        gap: m.
    """

    objective: Tensor
    gap: Tensor


@dataclass(frozen=True)
class BaseErrors:
    """The objective and the gap's RMSE of constant parameters, side by side in the last dimension.

    Attributes:
        with_history: of each driver's base over the horizon from each window on, `(N, B, W, 2)`.
        cold_start: the same of the pooled base.
        full_trajectory: of the pooled base over the whole training part, `(N, B, 2)`.
        floor: added to the objective.
        has_unit: whether the objective grows with the trajectories' scale.
    """

    with_history: Tensor
    cold_start: Tensor
    full_trajectory: Tensor
    floor: float
    has_unit: bool

    @classmethod
    def of(cls, training_data: TrainingData, dataset: RolloutDataset, horizon: int) -> BaseErrors:
        """Simulates the bases; `horizon` in windows."""
        stride, drivers = training_data.windows.stride, dataset.pair.shape[1]
        frames = torch.arange(dataset.tokens.shape[1], device=dataset.pair.device) * stride
        near = _ConstantParameters(training_data, dataset.batch, horizon * stride)
        far = _ConstantParameters(training_data, dataset.batch, int(dataset.last.max()))
        # The members of an ensemble have the same bases.
        first = slice(None, None, dataset.ensemble_size)
        pair, own = dataset.pair[first].flatten(), dataset.base[first].flatten(0, 1)
        pooled = dataset.pooled[first].repeat_interleave(drivers, 0)
        with_history = _placed(near.errors(pair, own, frames), dataset)
        cold_start = with_history
        if training_data.base is not None:
            cold_start = _placed(near.errors(pair, pooled, frames), dataset)
        full_trajectory = _placed(far.errors(pair, pooled, frames[:1]), dataset)[:, :, 0]
        objective = training_data.objective
        has_unit = bool(objective.unit)
        return cls(with_history, cold_start, full_trajectory, objective.floor, has_unit)

    def over_horizon(self, batch: RolloutBatch) -> Divisors:
        """Returns the divisors over the horizon from where each trajectory begins."""
        places = (batch.row, batch.place, batch.start)
        cold_start = batch.cold_start[..., None]
        errors = torch.where(cold_start, self.cold_start[places], self.with_history[places])
        return self._divisors(errors, batch)

    def over_full_trajectory(self, batch: RolloutBatch) -> Divisors:
        """Returns the divisors over each trajectory from the first frame to the last."""
        return self._divisors(self.full_trajectory[batch.row, batch.place], batch)

    def _divisors(self, errors: Tensor, batch: RolloutBatch) -> Divisors:
        """Takes the errors `(N, D, 2)` of unscaled trajectories."""
        objective, gap = errors[..., 0], errors[..., 1]
        if batch.scale is not None:
            gap = gap * batch.scale
            if self.has_unit:
                objective = objective * batch.scale
        return Divisors((objective + self.floor).clamp(min=_LEAST_DIVISOR), gap + _LEAST_GAP)


def _placed(errors: Tensor, dataset: RolloutDataset) -> Tensor:
    """Arranges errors of the ensembles' drivers in order as `(N, B, windows, 2)`."""
    networks, drivers = dataset.pair.shape
    of_ensembles = errors.view(networks // dataset.ensemble_size, drivers, -1, 2)
    return of_ensembles.repeat_interleave(dataset.ensemble_size, 0)


class _ConstantParameters:
    """Simulates constant parameters from many frames on, `steps` frames each."""

    def __init__(self, training_data: TrainingData, batch: PairBatch, steps: int) -> None:
        self.simulator = training_data.simulator
        self.objective = training_data.objective
        self.gap_rmse = GapRmse()
        self.batch = batch
        self.steps = steps
        self.last = training_data.split.frame.to(batch.lengths.device)

    @torch.no_grad()
    def errors(self, pair: Tensor, unit: Tensor, windows: Tensor) -> Tensor:
        """Returns the objective and the gap's RMSE over `steps` frames, `(R, windows, 2)`.

        Args:
            pair: which pair each of R rows is of, `(R,)`.
            unit: parameters in unit space, `(R, n)`.
            windows: frames at which trajectories begin, `(windows,)`.
        """
        size = max(1, _TABLE // (len(windows) * self.steps))
        parts = []
        for first in range(0, len(pair), size):
            rows = slice(first, first + size)
            parts.append(self._part(pair[rows], unit[rows], windows))
        return torch.cat(parts)

    def _part(self, pair: Tensor, unit: Tensor, windows: Tensor) -> Tensor:
        batch, end = self.batch, self.batch.mask.shape[1] - 1
        shape = (len(pair), len(windows))
        rows, first = pair[:, None].expand(shape), windows.clamp(max=end).expand(shape)
        frames = (windows + torch.arange(self.steps + 1, device=pair.device)[:, None])[:, None]
        index = frames.clamp(max=end).expand(-1, *shape)
        start = Start(
            batch.follower_position[rows, first],
            batch.follower_speed[rows, first],
            batch.follower_acceleration[rows, first],
        )
        length, leader_position = batch.leader_length[rows], batch.leader_position[rows, index]
        leader = Leader(
            leader_position[:-1],
            batch.leader_speed[rows, index[:-1]],
            batch.leader_acceleration[rows, index[:-1]],
            length,
        )
        parameters = self._by_name(unit)
        _, position, speed = self.simulator.advance(self.simulator.begin(start), leader, parameters)
        values = FrameValues(
            speed=speed,
            gap=leader_position[1:] - length - position,
            measured_speed=batch.follower_speed[rows, index[1:]],
            measured_gap=batch.gap[rows, index[1:]],
            dt=self.simulator.dt,
        )
        counted = (frames[1:] <= self.last[pair][:, None]).to(speed.dtype)
        objective = self.objective(values, counted)
        return torch.stack([objective, self.gap_rmse(values, counted)], -1)

    def _by_name(self, unit: Tensor) -> dict[str, Tensor]:
        """Returns the model's parameters by name, those that differ between rows as `(R, 1)`.

        What heads answer beyond them stands behind them, and is left out.
        """
        space = self.simulator.model.adaptation_space
        unit = unit[..., : len(space)]
        named = {}
        for name, value in space.unpack(space.from_unit(unit)).items():
            named[name] = value[:, None] if value.dim() else value
        return named
