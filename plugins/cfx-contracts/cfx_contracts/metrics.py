"""The contract of a metric, statement by statement. Shapes as in `cfx.evaluation.metrics.base`."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from cfx.core.contract import NotApplicable, expect_close
from cfx.evaluation.metrics.base import Metric, Trajectories
from cfx.evaluation.metrics.contract import FIRST, PAIRS, trajectories
from cfx_contracts import contract_of


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
    for field in fields(given):
        value = getattr(given, field.name)
        if isinstance(value, Tensor):
            assert torch.equal(value, getattr(expected, field.name)), (
                f"`compute` changed `{field.name}`, which every other metric reads too"
            )


def _flipped(marked: Tensor | None, where: Tensor) -> Tensor:
    assert marked is not None
    return marked ^ where


def _of_pairs(given: Trajectories, index: Tensor) -> Trajectories:
    chosen: dict[str, Any] = {}
    for field in fields(given):
        value = getattr(given, field.name)
        if isinstance(value, Tensor):
            chosen[field.name] = value[index]
    return replace(given, **chosen)


def _same(values: Tensor, expected: Tensor, message: str) -> None:
    expect_close(values, expected, rtol=1e-9, atol=1e-12, equal_nan=True, msg=message)


CONTRACT = contract_of(__name__, "metric", first=FIRST)
