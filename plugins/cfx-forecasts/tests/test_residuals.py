"""Residual accelerations measured on recordings whose process is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.models.krauss import Krauss
from cfx_forecasts.residuals import measure_residuals
from tests.drives import wavy_pairs
from tests.models.test_residual import Steady

DT = 0.1


def test_the_process_of_the_noise_is_found() -> None:
    """Speeds whose accelerations are an AR(1) process around what the model wants."""
    time, scale, frames = 2.0, 0.4, 20_000
    pairs = PairBatch.of(wavy_pairs(Krauss(), torch.tensor([[1.5, 0.1]]).double(), frames=60))
    kept = math.exp(-DT / time)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(frames, generator=generator).double() * scale * math.sqrt(1 - kept**2)
    residual = torch.zeros(frames).double()
    for k in range(1, frames):
        residual[k] = kept * residual[k - 1] + noise[k]
    speed = 1_000.0 + (DT * (0.5 + residual)).cumsum(0)
    row = speed[None]
    batch = replace(
        pairs,
        leader_position=row * 0,
        leader_speed=row * 0,
        leader_acceleration=row * 0,
        follower_position=row * 0,
        follower_speed=row,
        follower_acceleration=row * 0,
        lengths=torch.tensor([frames]),
        mask=torch.ones_like(row, dtype=torch.bool),
    )
    parameters, last = torch.tensor([[0.5]]).double(), torch.tensor([frames - 1])
    found = measure_residuals(Steady(limits=None), batch, parameters, last, 0.5)
    assert float(found.scale[0]) == pytest.approx(scale, rel=0.1)
    assert float(found.time[0]) == pytest.approx(time, rel=0.2)
    early = measure_residuals(Steady(limits=None), batch, parameters, last // 2, 0.5)
    assert float(early.scale[0]) != float(found.scale[0])


def test_a_driver_without_residual_has_none() -> None:
    true = torch.tensor([[1.5, 0.1], [2.0, 0.3]]).double()
    batch = PairBatch.of(wavy_pairs(Krauss(), true, frames=200))
    found = measure_residuals(Krauss(), batch, true, batch.lengths - 1, 0.5)
    assert float(found.scale.max()) < 1e-9
