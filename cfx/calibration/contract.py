"""The first statements of the contracts of objectives and optimizers.

Shapes: K frames, P problems, q candidates of each.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective
from cfx.calibration.optimizers import Optimizer
from cfx.core.contract import expect_close, expect_tensor

FRAMES, PROBLEMS, CANDIDATES = 12, 3, 4
DT = 0.1


def some_frames(dtype: torch.dtype = torch.float64, error: float = 1.0) -> FrameValues:
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
    return changed(frames, lambda signal: signal.to(dtype))


def counted_frames(dtype: torch.dtype = torch.float64) -> Tensor:
    """Returns which frames count, `(K, P, 1)`: all of the first problem, fewer of the others."""
    lengths = torch.tensor([FRAMES, FRAMES // 2, 3])[:, None]
    return (torch.arange(FRAMES)[:, None, None] < lengths).to(dtype)


def changed(frames: FrameValues, change: Callable[[Tensor], Tensor]) -> FrameValues:
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
    frames, counted = some_frames(), counted_frames()
    expected = objective(frames, counted)
    nothing = torch.tensor(torch.nan, dtype=torch.float64)
    if "speed" not in objective.signals:
        frames = frames._replace(speed=nothing, measured_speed=nothing)
    if "gap" not in objective.signals:
        frames = frames._replace(gap=nothing, measured_gap=nothing)
    expect_close(
        objective(frames, counted),
        expected,
        rtol=1e-7,
        atol=1e-8,
        msg="calibration computes no other signal than `signals` names: add what `terms` reads",
    )


def a_loss_is_finite_and_never_negative(objective: Objective) -> None:
    loss = objective(some_frames(), counted_frames())
    expect_tensor(loss, "finish", (PROBLEMS, CANDIDATES), torch.float64, "(*batch,)")
    assert bool(loss.isfinite().all()), "ordinary trajectories have a finite loss"
    assert bool((loss >= 0).all()), "a loss is never negative: training divides by it"


def float32_agrees_with_float64(objective: Objective) -> None:
    single = objective(some_frames(torch.float32), counted_frames(torch.float32))
    expect_tensor(single, "finish", (PROBLEMS, CANDIDATES), torch.float32, "(*batch,)")
    expect_close(
        single.double(),
        objective(some_frames(), counted_frames()),
        rtol=1e-4,
        atol=1e-5,
        msg="closed-loop training computes in float32: the loss must agree with float64",
    )


def says_how_much_it_does_in_whole_numbers(optimizer: Optimizer) -> None:
    numbers = {
        "evaluations(n)": optimizer.evaluations(5),
        "evaluations_at_once(n)": optimizer.evaluations_at_once(5),
        "returned(n)": optimizer.returned(5),
        "space_filling(n)": optimizer.space_filling(5),
        "bytes_per_problem(n)": optimizer.bytes_per_problem(5),
    }
    for name, value in numbers.items():
        least = int(name != "bytes_per_problem(n)")
        assert type(value) is int, f"{name} gives {value!r}; it must give a whole number"
        assert value >= least, f"{name} gives {value}; it must give at least {least}"
    assert numbers["space_filling(n)"] <= numbers["returned(n)"] <= numbers["evaluations(n)"], (
        f"space_filling(n) gives {numbers['space_filling(n)']}, returned(n)"
        f" {numbers['returned(n)']} and evaluations(n) {numbers['evaluations(n)']}: a search"
        " returns no more than it evaluates, and the sensitivity, which weighs windows, is measured"
        " over the first of what it returns"
    )


FIRST_OF_OBJECTIVES = (
    says_its_unit_and_its_signals,
    a_loss_is_finite_and_never_negative,
    reads_only_the_signals_it_names,
    float32_agrees_with_float64,
)
FIRST_OF_OPTIMIZERS = (says_how_much_it_does_in_whole_numbers,)
