"""A metric: what is measured of each simulated pair. This one is the mean time gap.

The evaluation calls `compute` for each method (default, driver_specific, policy), with the
trajectories of many pairs at once; tables, figures and MLflow show the numbers.
"""

from __future__ import annotations

import torch
from cfx.plugin import Metric, Trajectories
from torch import Tensor

SLOWEST = 1.0
"""m/s: below it a time gap says nothing."""


class TimeGap(Metric):
    """Mean of gap / speed over the frames with a speed of 1 m/s or more; NaN without any."""

    unit = "s"
    direction = "none"
    heading = "time gap"
    meaning = "mean of the gap over the speed, at 1 m/s or more"
    is_of_recording = True

    def compute(self, trajectories: Trajectories) -> Tensor:
        moving = trajectories.counted & (trajectories.speed >= SLOWEST)
        seconds = trajectories.gap / trajectories.speed
        return torch.where(moving, seconds, 0.0).sum(1) / moving.sum(1)
