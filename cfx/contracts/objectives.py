"""The contract of an objective, statement by statement.

Shapes: K frames, P problems, q candidates of each.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective
from cfx.contracts import contract_of, expect_close, expect_tensor

FRAMES, PROBLEMS, CANDIDATES = 12, 3, 4
DT = 0.1


def _frames(dtype: torch.dtype = torch.float64, error: float = 1.0) -> FrameValues:
    """Returns simulated signals `(K, P, q)` and measured ones `(K, P, 1)` of moving drivers."""
    draw = torch.Generator().manual_seed(5)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=torch.float64)

    measured_speed = uniform(3.0, 20.0, FRAMES, PROBLEMS, 1)
    measured_gap = uniform(5.0, 40.0, FRAMES, PROBLEMS, 1)
    shape = (FRAMES, PROBLEMS, CANDIDATES)
    speed = measured_speed + error * uniform(-2.0, 2.0, *shape)
    gap = measured_gap + error * uniform(-4.0, 4.0, *shape)
    frames = FrameValues(speed, gap, measured_speed, measured_gap, DT)
    return _changed(frames, lambda signal: signal.to(dtype))


def _counted(dtype: torch.dtype = torch.float64) -> Tensor:
    """Returns which frames count, `(K, P, 1)`: all of the first problem, fewer of the others."""
    lengths = torch.tensor([FRAMES, FRAMES // 2, 3])[:, None]
    return (torch.arange(FRAMES)[:, None, None] < lengths).to(dtype)


def _changed(frames: FrameValues, change: Callable[[Tensor], Tensor]) -> FrameValues:
    """Returns frames of which every signal was changed in the same way."""
    return FrameValues(
        change(frames.speed),
        change(frames.gap),
        change(frames.measured_speed),
        change(frames.measured_gap),
        frames.dt,
    )


def says_its_unit_and_its_signals(objective: Objective) -> None:
    assert isinstance(getattr(objective, "unit", None), str), (
        "an objective says the unit of its loss, such as unit = 'm/s'; '' for none"
    )
    signals = tuple(objective.signals)
    assert signals, "an objective reads the speed or the gap, or nothing could be calibrated"
    assert set(signals) <= {"speed", "gap"}, (
        f"signals says what is read, of 'speed' and 'gap'; it says {signals}"
    )
    assert objective.tie_tolerance >= 0, "tie_tolerance is a difference of losses, not negative"
    assert objective.floor >= 0, "floor is a loss, not negative"


def reads_only_the_signals_it_names(objective: Objective) -> None:
    frames, counted = _frames(), _counted()
    expected = objective(frames, counted)
    nothing = torch.tensor(torch.nan, dtype=torch.float64)
    if "speed" not in objective.signals:
        frames = frames._replace(speed=nothing, measured_speed=nothing)
    if "gap" not in objective.signals:
        frames = frames._replace(gap=nothing, measured_gap=nothing)
    found = objective(frames, counted)
    # Every job checks this, and `torch.testing` would import a second of PyTorch for it.
    is_same = found.shape == expected.shape and torch.allclose(found, expected, rtol=1e-7)
    assert is_same, (
        "calibration computes no other signal than `signals` names: add what `terms` reads"
    )


def a_loss_is_finite_and_never_negative(objective: Objective) -> None:
    loss = objective(_frames(), _counted())
    expect_tensor(loss, "finish", (PROBLEMS, CANDIDATES), torch.float64, "(*batch,)")
    assert bool(loss.isfinite().all()), "ordinary trajectories have a finite loss"
    assert bool((loss >= 0).all()), "a loss is never negative: training divides by it"


def a_perfect_simulation_has_the_lowest_loss(objective: Objective) -> None:
    counted = _counted()
    perfect = objective(_frames(error=0.0), counted)
    for error in (0.1, 1.0):
        assert bool((perfect < objective(_frames(error=error), counted)).all()), (
            "the measured trajectory itself must have a lower loss than any with errors"
        )


def a_standing_driver_has_a_finite_loss(objective: Objective) -> None:
    zero = torch.zeros((FRAMES, PROBLEMS, 1), dtype=torch.float64)
    crawling = zero + 0.1
    counted = _counted()
    standing = FrameValues(zero, zero, zero, zero, DT)
    moving = FrameValues(crawling, crawling, zero, zero, DT)
    for frames in (standing, moving):
        assert bool(objective(frames, counted).isfinite().all()), (
            "drivers stand in a queue: no loss may be divided by a measured signal that is 0"
        )


def frames_that_do_not_count_change_nothing(objective: Objective) -> None:
    frames, counted = _frames(), _counted()
    changed = _changed(frames, lambda signal: torch.where(counted > 0, signal, 1e3))
    expect_close(
        objective(changed, counted),
        objective(frames, counted),
        rtol=1e-9,
        atol=1e-12,
        msg="a frame that does not count may hold anything finite",
    )


def a_batch_equals_the_loop_over_it(objective: Objective) -> None:
    frames, counted = _frames(), _counted()
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
    frames, counted = _frames(), _counted()
    order = torch.tensor([2, 0, 1])
    moved = _changed(frames, lambda signal: signal[:, order])
    expect_close(
        objective(moved, counted[:, order]),
        objective(frames, counted)[order],
        msg="a trajectory's loss must not depend on its place in the batch",
    )


def time_may_be_any_dimension(objective: Objective) -> None:
    frames, counted = _frames(), _counted()
    last = _changed(frames, lambda signal: signal.movedim(0, -1))
    expect_close(
        objective(last, counted.movedim(0, -1), dim=-1),
        objective(frames, counted),
        msg="terms work frame by frame: no operation may assume which dimension is time",
    )


def _sums_of_frame(objective: Objective, k: int) -> tuple[Tensor, ...]:
    frame = _changed(_frames(), lambda signal: signal[k : k + 1])
    return objective.sums(frame, _counted()[k : k + 1])


def parts_add_up_to_the_whole(objective: Objective) -> None:
    frames, counted = _frames(), _counted()
    sums = _sums_of_frame(objective, 0)
    for k in range(1, FRAMES):
        step = _sums_of_frame(objective, k)
        assert len(step) == len(sums), "terms returns as many tensors in every call"
        added = []
        for total, term in zip(sums, step, strict=True):
            added.append(total + term)
        sums = tuple(added)
    expect_close(
        objective.finish(sums, counted.sum(0)),
        objective(frames, counted),
        msg="sums that were accumulated frame by frame must give the loss of the whole trajectory",
    )


def one_frame_needs_no_dimension_of_time(objective: Objective) -> None:
    frames = _frames()
    terms = objective.terms(_changed(frames, lambda signal: signal[0]))
    whole = objective.terms(frames)
    assert isinstance(terms, tuple), "terms returns a tuple of tensors"
    assert len(terms) == len(whole), "terms returns as many tensors in every call"
    for one, many in zip(terms, whole, strict=True):
        expect_close(
            one, many[0], msg="a rollout asks for the terms of one frame `(*batch,)` at a time"
        )


def float32_agrees_with_float64(objective: Objective) -> None:
    single = objective(_frames(torch.float32), _counted(torch.float32))
    expect_tensor(single, "finish", (PROBLEMS, CANDIDATES), torch.float32, "(*batch,)")
    expect_close(
        single.double(),
        objective(_frames(), _counted()),
        rtol=1e-4,
        atol=1e-5,
        msg="closed-loop training computes in float32: the loss must agree with float64",
    )


def gradients_are_right(objective: Objective) -> None:
    frames, counted = _frames(), _counted()

    def loss(speed: Tensor, gap: Tensor) -> Tensor:
        return objective(frames._replace(speed=speed, gap=gap), counted)

    speed = frames.speed.clone().requires_grad_()
    gap = frames.gap.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, (speed, gap)), (
        "closed-loop training follows the gradient of the loss: it must be that of the loss"
    )


def the_slope_at_a_perfect_simulation_is_finite(objective: Objective) -> None:
    frames, counted = _frames(error=0.0), _counted()
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
    frames, counted = _frames(), _counted()
    before = _changed(frames, torch.clone)
    objective(frames, counted)
    for signal, copy in zip(frames[:4], before[:4], strict=True):
        assert torch.equal(signal, copy), "an objective must not change what it is given in place"


CONTRACT = contract_of(
    __name__,
    "objective",
    first=[
        says_its_unit_and_its_signals,
        a_loss_is_finite_and_never_negative,
        reads_only_the_signals_it_names,
        float32_agrees_with_float64,
    ],
)
