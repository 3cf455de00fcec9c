"""The objectives `speed_rmse` and `gap_rmse`: root mean squared errors."""

from __future__ import annotations

from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective, root_mean_square


class SpeedRmse(Objective):
    """Root mean squared error of speed, m/s: the paper's objective."""

    unit = "m/s"
    metric = "rmse_speed"
    signals = ("speed",)
    tie_tolerance = 0.05
    floor = 0.2

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.speed - frames.measured_speed).square(),)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count, epsilon)


class GapRmse(Objective):
    """Root mean squared error of the gap, m.

    It identifies parameters better than an error of speed, because it keeps what an error of speed
    has added up to (Punzo et al. 2021, see `Objective`).
    """

    unit = "m"
    metric = "rmse_gap"
    signals = ("gap",)
    tie_tolerance = 0.05
    floor = 1.0

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.gap - frames.measured_gap).square(),)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count, epsilon)
