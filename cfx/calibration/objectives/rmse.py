"""Root mean squared errors of one signal."""

from __future__ import annotations

from torch import Tensor

from cfx.calibration.objectives.base import FrameValues, Objective, root_mean_square


class SpeedRmse(Objective):
    """Root mean squared error of speed, m/s: the paper's objective.

    Errors of spacing (`gap_rmse`) identify parameters better than errors of speed: Punzo, Zheng and
    Montanino (2021), *About calibration of car-following dynamics of automated and human-driven
    vehicles: Methodology, guidelines and codes*, Transportation Research Part C.
    """

    unit = "m/s"
    signals = ("speed",)
    tie_tolerance = 0.05
    floor = 0.2

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.speed - frames.measured_speed).square(),)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count, epsilon)


class GapRmse(Objective):
    """Root mean squared error of the gap, m.

    Errors of spacing identify parameters better than errors of speed, because an error of the gap
    keeps what an error of speed has added up to: Punzo, Zheng and Montanino (2021), *About
    calibration of car-following dynamics of automated and human-driven vehicles: Methodology,
    guidelines and codes*, Transportation Research Part C.
    """

    unit = "m"
    signals = ("gap",)
    tie_tolerance = 0.05
    floor = 1.0

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.gap - frames.measured_gap).square(),)

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count, epsilon)
