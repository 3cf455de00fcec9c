"""The population's parameters: all folds together against fold by fold in eager PyTorch, in the
same run.

`pytest tests/benchmarks --benchmark-only`. What counts are the ratios in `extra_info`: they compare
runs on one machine.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
import torch

from cfx.calibration.losses import PooledLosses, SegmentLosses
from cfx.calibration.rmse import SpeedRmse
from cfx.models.base import DrivingModel
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Segments

DRIVES, FOLDS, STEPS, CANDIDATES, DT, MEMORY = 70, 5, 600, 512, 0.1, 1 << 30


def drives(model: DrivingModel) -> SegmentLosses:
    """Returns drives behind leaders that speed up and slow down."""
    draw = torch.Generator().manual_seed(0)
    phase, swing = torch.rand((2, DRIVES), generator=draw, dtype=torch.float64)
    time_s = DT * torch.arange(STEPS, dtype=torch.float64)[:, None]
    speed = 10.0 + 4.0 * swing * torch.sin(0.3 * time_s + 6.0 * phase)
    acceleration = torch.diff(speed, dim=0, append=speed[-1:]) / DT
    nothing = torch.zeros(DRIVES, dtype=torch.float64)
    segments = Segments(
        leader_position=25.0 + speed.cumsum(0) * DT,
        leader_speed=speed,
        leader_acceleration=acceleration,
        leader_length=nothing + 4.5,
        position=nothing,
        speed=speed[0],
        acceleration=nothing,
        leader_rear=20.5 + speed.cumsum(0) * DT,
        measured_speed=speed,
        measured_gap=torch.full_like(speed, 20.0),
        counted=torch.ones_like(speed),
    )
    return SegmentLosses(MemoryStepper(model, DT), SpeedRmse(), segments)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("model", [Krauss(), W99()], ids=["krauss", "w99"])
def test_population(benchmark: Any, model: DrivingModel) -> None:
    compiled = drives(model)
    eager = replace(compiled, stepper=MemoryStepper(model, DT, compile="never"))
    fold = torch.arange(DRIVES) % FOLDS
    members = (fold != torch.arange(FOLDS + 1)[:, None]) | (
        torch.arange(FOLDS + 1)[:, None] == FOLDS
    )
    points = torch.quasirandom.SobolEngine(len(model.space), scramble=True, seed=0).draw(
        CANDIDATES, dtype=torch.float64
    )
    candidates = points.expand(FOLDS + 1, -1, -1)
    losses = benchmark.pedantic(
        PooledLosses(compiled, members, MEMORY), args=(candidates,), rounds=3, warmup_rounds=1
    )
    one_by_one = PooledLosses(eager, members, MEMORY)
    began = time.perf_counter()
    expected = torch.cat(
        [one_by_one.take(slice(k, k + 1))(candidates[k : k + 1]) for k in range(FOLDS + 1)]
    )
    seconds = time.perf_counter() - began
    torch.testing.assert_close(losses, expected, rtol=1e-6, atol=1e-9)
    benchmark.extra_info["times faster than fold by fold in eager PyTorch"] = (
        seconds / benchmark.stats["median"]
    )
