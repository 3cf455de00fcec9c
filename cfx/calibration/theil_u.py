"""The objective `theil_u`: Theil's U."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from pydantic import Field
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective, Signal, ratio, root_mean_square
from cfx.core.component import Settings


class TheilUSettings(Settings):
    """Settings of `TheilInequality`."""

    signal: Signal = Field("speed", description="what is compared: speed or gap")


class TheilInequality(Objective):
    """Theil's U: an error between 0 (perfect) and 1, without unit.

    The root mean squared error, divided by the sum of the root mean squares of the simulated and of
    the measured signal: `U = RMSE / (RMS_simulated + RMS_measured)`, Theil's form of 1961
    (*Economic Forecasts and Policy*, North-Holland). U is 0 where both signals are 0.
    """

    schema: ClassVar[type[Settings]] = TheilUSettings
    settings: TheilUSettings
    unit = ""
    tie_tolerance = 0.0025
    floor = 0.01

    @property
    def signals(self) -> Sequence[Signal]:  # type: ignore[override]  # it follows from the settings
        return (self.settings.signal,)

    @property
    def metric(self) -> str:  # type: ignore[override]  # it follows from the settings
        return "theil_u" if self.settings.signal == "speed" else ""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        simulated, measured = frames.speed, frames.measured_speed
        if self.settings.signal == "gap":
            simulated, measured = frames.gap, frames.measured_gap
        return (simulated - measured).square(), simulated.square(), measured.square()

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        errors, simulated, measured = sums
        error = root_mean_square(errors, count, epsilon)
        size = root_mean_square(simulated, count, epsilon) + root_mean_square(
            measured, count, epsilon
        )
        return ratio(error, size)
