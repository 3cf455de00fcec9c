"""What a trajectory's parameters tell. Shapes: P pairs, K + 1 frames, n tuned parameters."""

from __future__ import annotations

from torch import Tensor

from cfx.evaluation.metrics.base import Metric, Trajectories
from cfx.evaluation.metrics.masked import masked_mean

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
