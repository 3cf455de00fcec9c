"""The objective `speed_huber`."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import huber_loss

from cfx.calibration.objectives import FrameValues
from cfx.calibration.rmse import SpeedRmse
from cfx.core.component import Settings


class SpeedHuberSettings(Settings):
    """Settings of `SpeedHuber`."""

    delta: float = Field(
        1.0, gt=0, description="m/s: larger errors count in proportion, not squared"
    )


class SpeedHuber(SpeedRmse):
    """Root of twice the mean Huber loss of speed, m/s: large errors weigh less than in an RMSE.

    P. J. Huber (1964), *Robust estimation of a location parameter*, Annals of Mathematical
    Statistics 35.

    An error up to `delta` counts squared, as in `speed_rmse`; a larger one counts
    `delta (2 |error| - delta)`. Without larger errors the loss is the root mean squared error.
    """

    schema: ClassVar[type[Settings]] = SpeedHuberSettings
    settings: SpeedHuberSettings
    metric = ""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        error = frames.speed - frames.measured_speed
        losses = huber_loss(
            error, torch.zeros_like(error), reduction="none", delta=self.settings.delta
        )
        return (2.0 * losses,)
