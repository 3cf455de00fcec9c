"""Terms of a trajectory's loss against closed forms."""

from __future__ import annotations

import pytest
import torch

from cfx.calibration.rmse import SpeedRmse
from cfx.learners.rollout.loss import Divisors, TrajectoryLoss
from cfx.learners.rollout.settings import LossSettings
from cfx.learners.rollout.window import MeasuredFrames, Segment

DT = 0.1
FRAMES = 8


def segment(jerk: float, paths: int = 1) -> Segment:
    """Returns simulated speeds of constant jerk, 1 m/s above the measured ones, gaps 2 m wider."""
    time = DT * torch.arange(FRAMES, dtype=torch.float64)
    measured = (10.0 + 0.5 * jerk * time**2).expand(1, paths, FRAMES)
    gap = torch.full_like(measured, 20.0)
    known = MeasuredFrames(measured, gap, torch.ones_like(measured))
    return Segment(measured + 1.0, gap + 2.0, known, None)


def loss(jerk_weight: float, gap_weight: float) -> TrajectoryLoss:
    settings = LossSettings(jerk_weight=jerk_weight, gap_weight=gap_weight)
    return TrajectoryLoss(SpeedRmse(), settings, DT)


DIVISORS = Divisors(torch.full((1, 1), 4.0), torch.full((1, 1), 5.0))


@pytest.mark.parametrize("jerk_weight", [0.0, 0.2, 2.0])
def test_each_term_has_its_weight(jerk_weight: float) -> None:
    """An error of 1 m/s over 4 m/s, one of 2 m over 5 m, and a jerk of 3 m/s3."""
    value = float(loss(jerk_weight, gap_weight=0.5)(segment(jerk=3.0), DIVISORS))
    assert value == pytest.approx(1 / 4 + 0.5 * 2 / 5 + jerk_weight * 3.0, rel=1e-3)


@pytest.mark.parametrize("jerk_weight", [0.0, 0.2, 2.0])
def test_sampled_paths_have_the_same_weights(jerk_weight: float) -> None:
    """Equal paths have no spread: the CRPS of each is its absolute error."""
    sampled = segment(jerk=3.0, paths=2)
    value = float(loss(jerk_weight, gap_weight=0.5).of_paths(sampled, DIVISORS, paths=2))
    assert value == pytest.approx(1 / 4 + 0.5 * 2 / 5 + jerk_weight * 3.0, rel=1e-3)
