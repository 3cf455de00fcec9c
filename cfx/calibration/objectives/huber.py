"""Errors of speed of which outliers count less.

P. J. Huber (1964), *Robust estimation of a location parameter*, Annals of Mathematical Statistics
35.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import huber_loss

from cfx.calibration.objectives.base import FrameValues, Objective, root_mean_square
from cfx.core.component import Settings


class SpeedHuberSettings(Settings):
    """Settings of `SpeedHuber`."""

    delta: float = Field(
        1.0, gt=0, description="m/s: larger errors count in proportion, not squared"
    )


class SpeedHuber(Objective):
    """Root of twice the mean Huber loss of speed, m/s: large errors weigh less than in an RMSE.

    An error up to `delta` counts squared, as in `speed_rmse`; a larger one counts
    `delta (2 |error| - delta)`. Without larger errors the loss is the root mean squared error.

    Errors of spacing (`gap_rmse`) identify parameters better than errors of speed: Punzo, Zheng and
    Montanino (2021), *About calibration of car-following dynamics of automated and human-driven
    vehicles: Methodology, guidelines and codes*, Transportation Research Part C.
    """

    schema: ClassVar[type[Settings]] = SpeedHuberSettings
    settings: SpeedHuberSettings
    unit = "m/s"
    signals = ("speed",)
    tie_tolerance = 0.05
    floor = 0.2

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        error = frames.speed - frames.measured_speed
        losses = huber_loss(
            error, torch.zeros_like(error), reduction="none", delta=self.settings.delta
        )
        return (2.0 * losses,)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count, epsilon)
