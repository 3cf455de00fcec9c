"""Residuals between measured accelerations and those of a model with constant parameters.

Shapes: P pairs, T frames, n tuned parameters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.plugin import DrivingModel, Follower, Leader, PairBatch, advance_vehicle


class ResidualStatistics(NamedTuple):
    """An AR(1) process of residual accelerations, for each pair, `(P,)`.

    Attributes:
        time: time constant with which the correlation falls, s; NaN where there is none.
        scale: standard deviation, m/s2.
    """

    time: Tensor
    scale: Tensor


@torch.no_grad()
def measure_residuals(
    model: DrivingModel, batch: PairBatch, parameters: Tensor, last: Tensor, lag_s: float
) -> ResidualStatistics:
    """Measures residual accelerations at measured states: measured minus the model's, as limited.

    The time constant is that of an AR(1) process with the correlation r at the lag,
    `-lag / ln r`: the moment estimate of C. Zhang and L. Sun (2024), *Bayesian calibration of the
    intelligent driver model*, IEEE T-ITS 25(8), whose errors are AR too. Difference: parameters and
    errors are not estimated together.

    A model with a memory begins anew at each frame.

    Args:
        model: the driving model.
        batch: P pairs.
        parameters: `(P, n)`, SI units.
        last: `(P,)`, the last frame that may be read.
        lag_s: s.
    """
    speed = batch.follower_speed
    follower = Follower(
        batch.follower_position,
        speed,
        batch.follower_acceleration,
        model.initial_memory(speed),
    )
    leader = Leader(
        batch.leader_position,
        batch.leader_speed,
        batch.leader_acceleration,
        batch.leader_length[:, None],
    )
    p = {}
    for name, value in model.space.unpack(parameters).items():
        p[name] = value[:, None] if value.dim() else value
    alone = (advance_vehicle(model, follower, leader, p, batch.dt).speed - speed) / batch.dt
    residual = speed.diff(dim=1) / batch.dt - alone[:, :-1]
    counted = torch.arange(residual.shape[1], device=last.device) < last[:, None]
    residual = torch.where(counted, residual, 0.0)
    count = counted.sum(1).clamp(min=1)
    square = residual.square().sum(1) / count
    lag = max(1, round(lag_s / batch.dt))
    pairs = (counted[:, lag:] & counted[:, :-lag]).sum(1).clamp(min=1)
    correlation = (residual[:, lag:] * residual[:, :-lag]).sum(1) / pairs / square
    inside = (correlation > 0) & (correlation < 1)
    time = -lag * batch.dt / torch.log(torch.where(inside, correlation, math.exp(-1.0)))
    return ResidualStatistics(torch.where(inside, time, torch.nan), square.sqrt())
