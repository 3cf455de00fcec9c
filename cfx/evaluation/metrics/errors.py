"""How far a simulated trajectory is from the recorded one.

The measures of goodness of fit that the calibration literature uses: V. Punzo, Z. Zheng, M.
Montanino (2021), About calibration of car-following dynamics of automated and human-driven
vehicles: methodology, guidelines and codes, Transportation Research Part C 128, 103165.

Shapes: P pairs, K + 1 frames. e = simulated - measured; v and s are the measured speed and gap;
sums run over the K' frames that count.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.evaluation.metrics.base import RMSE_SPEED, Metric, Trajectories


def masked_mean(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the mean of `(P, K)` over the counted frames, `(P,)`; NaN where none counts."""
    return torch.where(counted, values, 0.0).sum(1) / counted.sum(1)


def root_mean_square(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the root mean square of `(P, K)` over them, `(P,)`; NaN where none counts."""
    return (torch.where(counted, values, 0.0).square().sum(1) / counted.sum(1)).sqrt()


class ErrorMetric(Metric):
    """Base of distances from the recording."""

    direction = "lower"
    is_error = True
    headline = False


class RmseSpeed(ErrorMetric):
    """Root mean square error of speed: sqrt(sum e^2 / K')."""

    unit = RMSE_SPEED.unit
    heading = RMSE_SPEED.heading
    meaning = RMSE_SPEED.meaning
    scopes = ("test", "steady", "full_trajectory")
    headline = True
    order = 1

    def compute(self, trajectories: Trajectories) -> Tensor:
        error = trajectories.speed - trajectories.measured_speed
        return root_mean_square(error, trajectories.counted)


class RmseGap(ErrorMetric):
    """Root mean square error of the gap: sqrt(sum e^2 / K')."""

    unit = "m"
    heading = "RMSE of gap"
    meaning = (
        "root mean square difference between the simulated and the measured gap, bumper to bumper"
    )
    scopes = ("test", "full_trajectory")
    headline = True
    order = 2

    def compute(self, trajectories: Trajectories) -> Tensor:
        error = trajectories.gap - trajectories.measured_gap
        return root_mean_square(error, trajectories.counted)


class MaeSpeed(ErrorMetric):
    """Mean absolute error of speed: sum |e| / K'."""

    unit = "m/s"
    heading = "MAE of speed"
    meaning = "mean absolute difference between the simulated and the measured speed"
    order = 11

    def compute(self, trajectories: Trajectories) -> Tensor:
        error = trajectories.speed - trajectories.measured_speed
        return masked_mean(error.abs(), trajectories.counted)


class MaeGap(ErrorMetric):
    """Mean absolute error of the gap: sum |e| / K'."""

    unit = "m"
    heading = "MAE of gap"
    meaning = "mean absolute difference between the simulated and the measured gap"
    order = 12

    def compute(self, trajectories: Trajectories) -> Tensor:
        error = trajectories.gap - trajectories.measured_gap
        return masked_mean(error.abs(), trajectories.counted)


class NrmseSpeed(ErrorMetric):
    """Normalised RMSE of speed (Punzo et al. 2021): RMSE / sqrt(sum v^2 / K')."""

    unit = ""
    heading = "NRMSE of speed"
    meaning = "RMSE of speed over the root mean square of the measured speed"
    order = 13

    def compute(self, trajectories: Trajectories) -> Tensor:
        return _normalised(trajectories.speed, trajectories.measured_speed, trajectories.counted)


class NrmseGap(ErrorMetric):
    """Normalised RMSE of the gap (Punzo et al. 2021): RMSE / sqrt(sum s^2 / K')."""

    unit = ""
    heading = "NRMSE of gap"
    meaning = "RMSE of the gap over the root mean square of the measured gap"
    order = 14

    def compute(self, trajectories: Trajectories) -> Tensor:
        return _normalised(trajectories.gap, trajectories.measured_gap, trajectories.counted)


class RmseAcceleration(ErrorMetric):
    """Root mean square error of acceleration: sqrt(sum e^2 / K').

    Both accelerations are differences of successive speeds over the time step, so that the
    recording's own column of accelerations, often smoothed in its own way, plays no part.
    """

    unit = "m/s2"
    heading = "RMSE of acceleration"
    meaning = "root mean square difference between the simulated and the measured acceleration"
    order = 15

    def compute(self, trajectories: Trajectories) -> Tensor:
        error = trajectories.speed - trajectories.measured_speed
        return root_mean_square(error.diff(dim=1) / trajectories.dt, trajectories.counted[:, 1:])


class TheilU(ErrorMetric):
    """Theil's inequality coefficient of speed.

    U = sqrt(sum e^2 / K') / (sqrt(sum v_sim^2 / K') + sqrt(sum v^2 / K')): from 0, no error, to 1.
    This is the bounded form (H. Theil 1961, Economic Forecasts and Policy) that calibrations of
    traffic models use (J. Hourdakis, P. Michalopoulos, J. Kottommannil 2003, Transportation
    Research Record 1852), not the later U2, which compares with a naive forecast.
    """

    unit = ""
    heading = "Theil's U"
    meaning = "RMSE of speed over the sum of both root mean square speeds, from 0 to 1"
    order = 16

    def compute(self, trajectories: Trajectories) -> Tensor:
        speed, measured = trajectories.speed, trajectories.measured_speed
        counted = trajectories.counted
        size = root_mean_square(speed, counted) + root_mean_square(measured, counted)
        return _ratio(root_mean_square(speed - measured, counted), size)


class FinalPositionError(ErrorMetric):
    """|x_sim - x| at the last frame that counts.

    Speed errors of opposite signs cancel in it and lasting ones add up. As both follow the same
    leader, it is the absolute difference of the gaps.
    """

    unit = "m"
    heading = "final position error"
    meaning = "distance between the simulated and the real follower at the last frame"
    order = 17

    def compute(self, trajectories: Trajectories) -> Tensor:
        counted = trajectories.counted
        frames = torch.arange(counted.shape[1], device=counted.device)
        last = torch.where(counted, frames, 0).amax(1, keepdim=True)
        error = (trajectories.gap - trajectories.measured_gap).gather(1, last)[:, 0].abs()
        return torch.where(counted.any(1), error, torch.nan)


def _normalised(simulated: Tensor, measured: Tensor, counted: Tensor) -> Tensor:
    error = root_mean_square(simulated - measured, counted)
    return _ratio(error, root_mean_square(measured, counted))


def _ratio(error: Tensor, size: Tensor) -> Tensor:
    """Returns `error / size` `(P,)`; NaN where there is nothing to divide by."""
    return torch.where(size > 0, error / size, torch.nan)
