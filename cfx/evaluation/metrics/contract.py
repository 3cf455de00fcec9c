"""The first statement of a metric's contract. Shapes as in `cfx.evaluation.metrics.base`."""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.core.contract import expect_tensor
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.evaluation.metrics.base import Metric, Trajectories

PAIRS, FRAMES, DT = 5, 80, 0.1


def trajectories(dtype: torch.dtype = torch.float64) -> Trajectories:
    """Returns followers that swing around the recorded ones.

    One brakes hard, one collides, one has few frames.
    """
    time = DT * torch.arange(FRAMES, dtype=torch.float64)
    phase = torch.arange(PAIRS, dtype=torch.float64)[:, None]
    measured_speed = 12.0 + 2.0 * torch.sin(0.5 * time + phase)
    speed = measured_speed + (0.2 + 0.1 * phase) * torch.sin(time + 2 * phase)
    speed[1, 40:] -= 1.5
    measured_gap = 20.0 + 2.0 * torch.cos(0.5 * time + phase)
    gap = measured_gap - (DT * (speed - measured_speed)).cumsum(1)
    gap[2, 50:] -= 30.0
    wave = torch.sin(0.3 * time + phase)
    parameters = torch.stack([1.5 + 0.9 * wave, 2.0 + 0.99 * wave], dim=-1)
    frames = torch.tensor([FRAMES, FRAMES, FRAMES, 60, 12])[:, None]
    counted = torch.arange(FRAMES) < frames
    counted[:, 0] = False
    space = ParameterSpace.of(
        Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap"),
        Parameter("a", "m/s2", 1.0, 3.0, 2.0, "maximum acceleration"),
    )
    leader_speed = measured_speed + 0.3 * torch.cos(time)
    return Trajectories(
        speed=speed.to(dtype),
        gap=gap.to(dtype),
        measured_speed=measured_speed.to(dtype),
        measured_gap=measured_gap.to(dtype),
        leader_speed=leader_speed.to(dtype),
        parameters=parameters.to(dtype),
        counted=counted,
        dt=DT,
        space=space,
        at_limits=torch.arange(FRAMES) % (3 + torch.arange(PAIRS)[:, None]) == 0,
        outside=torch.arange(FRAMES) % (4 + torch.arange(PAIRS)[:, None]) == 1,
    )


def a_metric_gives_one_number_for_each_pair(metric: Metric) -> None:
    for dtype in (torch.float64, torch.float32):
        values = metric.compute(trajectories(dtype))
        expected = (
            values.dtype if isinstance(values, Tensor) and values.is_floating_point() else dtype
        )
        expect_tensor(values, "compute", (PAIRS,), expected, "a number for each pair, (pairs,)")
        assert not bool(values.isinf().any()), (
            "a number that is not defined is NaN, not infinite: it would make every mean infinite"
        )
        assert bool(values.isfinite().any()), (
            "of ordinary trajectories at least one must have a number that is defined"
        )


FIRST = (a_metric_gives_one_number_for_each_pair,)
