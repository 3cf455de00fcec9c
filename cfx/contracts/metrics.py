"""The contract of a metric, statement by statement. Shapes as in `cfx.evaluation.metrics.base`."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from cfx.contracts import NotApplicable, contract_of, expect_close, expect_tensor
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
        given = values.dtype if isinstance(values, Tensor) and values.is_floating_point() else dtype
        expect_tensor(values, "compute", (PAIRS,), given, "a number for each pair, (pairs,)")
        assert not bool(values.isinf().any()), (
            "a number that is not defined is NaN, not infinite: it would make every mean infinite"
        )
        assert bool(values.isfinite().any()), (
            "of ordinary trajectories at least one must have a number that is defined"
        )


def frames_that_do_not_count_do_not_matter(metric: Metric) -> None:
    given = trajectories()
    outside = ~given.counted
    outside[:, 0] = False  # frame 0 is the measured state that the simulation starts from
    for value in (torch.nan, 1e3, -1e3):
        changed: dict[str, Any] = {}
        for name in ("speed", "gap", "measured_speed", "measured_gap", "leader_speed"):
            changed[name] = getattr(given, name).masked_fill(outside, value)
        other = replace(
            given,
            **changed,
            parameters=given.parameters.masked_fill(outside[..., None], value),
            at_limits=_flipped(given.at_limits, outside),
            outside=_flipped(given.outside, outside),
        )
        _same(
            metric.compute(other),
            metric.compute(given),
            "frames that do not count were changed, and the numbers with them: beyond its end a"
            " pair is padded, and the padding was not simulated",
        )


def a_batch_equals_the_loop_over_it(metric: Metric) -> None:
    given = trajectories()
    alone = [metric.compute(_of_pairs(given, torch.tensor([k]))) for k in range(PAIRS)]
    _same(
        metric.compute(given),
        torch.cat(alone),
        "a pair's number depends on the pairs that are measured beside it",
    )


def the_order_of_the_pairs_does_not_matter(metric: Metric) -> None:
    given = trajectories()
    order = torch.tensor([3, 0, 4, 1, 2])
    _same(
        metric.compute(_of_pairs(given, order)),
        metric.compute(given)[order],
        "a pair's number depends on its place among the others",
    )


def a_simulation_without_error_has_none(metric: Metric) -> None:
    if not (metric.is_error and metric.direction == "lower"):
        raise NotApplicable("it is no distance from the recording")
    given = trajectories()
    perfect = replace(given, speed=given.measured_speed, gap=given.measured_gap)
    values = metric.compute(perfect)
    assert bool((values.abs() < 1e-12).all()), (
        "`is_error` says that the number is a distance from the recording, so it must be 0 for the"
        " recording itself"
    )
    assert bool((metric.compute(given) > 0).all()), (
        "the number must be positive where the simulation differs from the recording"
    )


def single_precision_agrees_with_double(metric: Metric) -> None:
    expect_close(
        metric.compute(trajectories(torch.float32)).double(),
        metric.compute(trajectories()).double(),
        rtol=1e-3,
        atol=1e-3,
        equal_nan=True,
        msg="jobs may simulate in single precision: the numbers must agree with those in double",
    )


def inputs_stay_as_they_are(metric: Metric) -> None:
    given, expected = trajectories(), trajectories()
    metric.compute(given)
    for one in fields(given):
        value = getattr(given, one.name)
        if isinstance(value, Tensor):
            assert torch.equal(value, getattr(expected, one.name)), (
                f"`compute` changed `{one.name}`, which every other metric reads too"
            )


def _flipped(marked: Tensor | None, where: Tensor) -> Tensor:
    assert marked is not None
    return marked ^ where


def _of_pairs(given: Trajectories, index: Tensor) -> Trajectories:
    chosen: dict[str, Any] = {}
    for one in fields(given):
        value = getattr(given, one.name)
        if isinstance(value, Tensor):
            chosen[one.name] = value[index]
    return replace(given, **chosen)


def _same(values: Tensor, expected: Tensor, message: str) -> None:
    expect_close(values, expected, rtol=1e-9, atol=1e-12, equal_nan=True, msg=message)


CONTRACT = contract_of(__name__, "metric", first=[a_metric_gives_one_number_for_each_pair])
