"""The contract of an objective, statement by statement.

Shapes: K frames, P problems, q candidates of each.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.calibration.contract import (
    CANDIDATES,
    DT,
    FIRST_OF_OBJECTIVES,
    FRAMES,
    PROBLEMS,
    changed,
    counted_frames,
    some_frames,
)
from cfx.calibration.objectives import FrameValues, Objective
from cfx.core.contract import expect_close
from cfx.evaluation.metrics.base import MetricSet
from cfx.evaluation.metrics.contract import trajectories
from cfx.evaluation.metrics.objective import ObjectiveMetric, judged_by
from cfx_contracts import contract_of


def a_perfect_simulation_has_the_lowest_loss(objective: Objective) -> None:
    counted = counted_frames()
    perfect = objective(some_frames(error=0.0), counted)
    for error in (0.1, 1.0):
        assert bool((perfect < objective(some_frames(error=error), counted)).all()), (
            "the measured trajectory itself must have a lower loss than any with errors"
        )


def a_standing_driver_has_a_finite_loss(objective: Objective) -> None:
    zero = torch.zeros((FRAMES, PROBLEMS, 1), dtype=torch.float64)
    crawling = zero + 0.1
    counted = counted_frames()
    standing = FrameValues(zero, zero, zero, zero, DT)
    moving = FrameValues(crawling, crawling, zero, zero, DT)
    for frames in (standing, moving):
        assert bool(objective(frames, counted).isfinite().all()), (
            "drivers stand in a queue: no loss may be divided by a measured signal that is 0"
        )


def frames_that_do_not_count_change_nothing(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    altered = changed(frames, lambda signal: torch.where(counted > 0, signal, 1e3))
    expect_close(
        objective(altered, counted),
        objective(frames, counted),
        rtol=1e-9,
        atol=1e-12,
        msg="a frame that does not count may hold anything finite",
    )


def a_batch_equals_the_loop_over_it(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    together = objective(frames, counted)
    for p in range(PROBLEMS):
        for c in range(CANDIDATES):
            alone = FrameValues(
                frames.speed[:, p, c],
                frames.gap[:, p, c],
                frames.measured_speed[:, p, 0],
                frames.measured_gap[:, p, 0],
                DT,
            )
            expect_close(
                together[p, c],
                objective(alone, counted[:, p, 0]),
                msg="a trajectory's loss must not depend on what stands beside it in the batch",
            )


def the_order_in_the_batch_does_not_matter(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    order = torch.tensor([2, 0, 1])
    moved = changed(frames, lambda signal: signal[:, order])
    expect_close(
        objective(moved, counted[:, order]),
        objective(frames, counted)[order],
        msg="a trajectory's loss must not depend on its place in the batch",
    )


def time_may_be_any_dimension(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    last = changed(frames, lambda signal: signal.movedim(0, -1))
    expect_close(
        objective(last, counted.movedim(0, -1), dim=-1),
        objective(frames, counted),
        msg="terms work frame by frame: no operation may assume which dimension is time",
    )


def _sums_of_frame(objective: Objective, k: int) -> tuple[Tensor, ...]:
    frame = changed(some_frames(), lambda signal: signal[k : k + 1])
    return objective.sums(frame, counted_frames()[k : k + 1])


def parts_add_up_to_the_whole(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    sums = _sums_of_frame(objective, 0)
    for k in range(1, FRAMES):
        step = _sums_of_frame(objective, k)
        assert len(step) == len(sums), "terms returns as many tensors in every call"
        added = [total + term for total, term in zip(sums, step, strict=True)]
        sums = tuple(added)
    expect_close(
        objective.finish(sums, counted.sum(0)),
        objective(frames, counted),
        msg="sums that were accumulated frame by frame must give the loss of the whole trajectory",
    )


def one_frame_needs_no_dimension_of_time(objective: Objective) -> None:
    frames = some_frames()
    terms = objective.terms(changed(frames, lambda signal: signal[0]))
    whole = objective.terms(frames)
    assert isinstance(terms, tuple), "terms returns a tuple of tensors"
    assert len(terms) == len(whole), "terms returns as many tensors in every call"
    for of_frame, many in zip(terms, whole, strict=True):
        expect_close(
            of_frame, many[0], msg="a rollout asks for the terms of one frame `(*batch,)` at a time"
        )


def it_is_the_metric_that_it_names(objective: Objective) -> None:
    if not objective.metric:
        return
    metric = judged_by(MetricSet.of(["rmse_speed"]), objective).metrics[0].component
    frames = trajectories()
    expect_close(
        ObjectiveMetric("", objective).compute(frames),
        metric.compute(frames),
        msg=f"`metric` says that the loss is the metric {objective.metric}: both must be one"
        ' number; "" where there is no such metric',
    )


def gradients_are_right(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()

    def loss(speed: Tensor, gap: Tensor) -> Tensor:
        return objective(frames._replace(speed=speed, gap=gap), counted)

    speed = frames.speed.clone().requires_grad_()
    gap = frames.gap.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, (speed, gap)), (
        "closed-loop training follows the gradient of the loss: it must be that of the loss"
    )


def the_slope_at_a_perfect_simulation_is_finite(objective: Objective) -> None:
    frames, counted = some_frames(error=0.0), counted_frames()
    speed = frames.speed.clone().requires_grad_()
    gap = frames.gap.clone().requires_grad_()
    loss = objective(frames._replace(speed=speed, gap=gap), counted, epsilon=1e-4)
    slopes = torch.autograd.grad(loss.sum(), (speed, gap), allow_unused=True)
    for slope in slopes:
        assert slope is None or bool(slope.isfinite().all()), (
            "finish adds epsilon to every mean square before the root, so that training goes on"
            " where the simulation is perfect"
        )


def what_it_is_given_stays_as_it_is(objective: Objective) -> None:
    frames, counted = some_frames(), counted_frames()
    before = changed(frames, torch.clone)
    objective(frames, counted)
    for signal, copy in zip(frames[:4], before[:4], strict=True):
        assert torch.equal(signal, copy), "an objective must not change what it is given in place"


CONTRACT = contract_of(__name__, "objective", first=FIRST_OF_OBJECTIVES)
