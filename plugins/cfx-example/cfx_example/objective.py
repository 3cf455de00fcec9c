"""An objective: what calibration makes small. This one is the mean absolute error of the gap.

The simulation calls `terms` at each time step, for all drivers and candidates at once, and adds up
what it gives; `finish` turns the sums into losses. So no trajectory is kept.
"""

from __future__ import annotations

from cfx.plugin import FrameValues, Objective, Settings
from pydantic import Field
from torch import Tensor


class GapMaeSettings(Settings):
    """Settings of `gap_mae`."""

    smoothing: float = Field(
        0.1, gt=0, description="m: smaller errors count squared, so that the slope has no jump at 0"
    )


class GapMae(Objective):
    """Mean absolute error of the gap, m.

    It is rounded off near 0: sqrt(error^2 + smoothing^2) - smoothing.
    """

    schema = GapMaeSettings
    settings: GapMaeSettings
    unit = "m"
    signals = ("gap",)
    tie_tolerance = 0.05
    floor = 1.0

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        error = frames.gap - frames.measured_gap
        smoothing = self.settings.smoothing
        return ((error.square() + smoothing**2).sqrt() - smoothing,)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return sums[0] / count
