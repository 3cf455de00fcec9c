"""The objective `mixed`: errors of speed and gap together."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective, root_mean_square
from cfx.core.component import Settings

_LEAST_RMS = 1.0
"""m/s and m: a measured signal with a smaller RMS counts as this large. A driver who stands has a
speed of 0, by which no error can be divided."""


class MixedSettings(Settings):
    """Settings of `Mixed`."""

    speed_weight: float = Field(1.0, ge=0, description="weight of the normalised error of speed")
    gap_weight: float = Field(1.0, ge=0, description="weight of the normalised error of the gap")

    @model_validator(mode="after")
    def _some_weight(self) -> Self:
        if self.speed_weight == 0 and self.gap_weight == 0:
            raise ValueError(
                "objective.speed_weight=0 and objective.gap_weight=0 leave nothing to minimise;"
                " give one of them a positive value"
            )
        return self


class Mixed(Objective):
    """Weighted sum of the normalised errors of speed and gap, without unit.

    Each part is a root mean squared error divided by the root mean square of the measured signal
    (at least 1 m/s or 1 m): `w_v RMSE(v) / RMS(v_measured) + w_s RMSE(s) / RMS(s_measured)`.
    """

    schema: ClassVar[type[Settings]] = MixedSettings
    settings: MixedSettings
    unit = ""
    tie_tolerance = 0.01
    floor = 0.04

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return (
            (frames.speed - frames.measured_speed).square(),
            (frames.gap - frames.measured_gap).square(),
            frames.measured_speed.square(),
            frames.measured_gap.square(),
        )

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        speed_errors, gap_errors, speeds, gaps = sums
        speed_part = root_mean_square(speed_errors, count, epsilon) / _scale(speeds, count)
        gap_part = root_mean_square(gap_errors, count, epsilon) / _scale(gaps, count)
        return self.settings.speed_weight * speed_part + self.settings.gap_weight * gap_part


def _scale(squares: Tensor, count: Tensor) -> Tensor:
    """Returns the measured signal's RMS, at least `_LEAST_RMS`."""
    return root_mean_square(squares, count).clamp(min=_LEAST_RMS)
