"""Each statement of the contract fails for an objective that breaks it, and says so."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.calibration import contract as first
from cfx.calibration.objectives import FrameValues, Objective, root_mean_square
from cfx.calibration.rmse import SpeedRmse
from cfx.calibration.theil_u import TheilInequality
from cfx_contracts import check_contract
from cfx_contracts import objectives as checks


class Silent(SpeedRmse):
    unit = None  # type: ignore[assignment]  # the mistake to be found


class Blind(SpeedRmse):
    signals = ()


class Secretive(SpeedRmse):
    """Reads the gap, which it does not name."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.gap - frames.measured_gap).square(),)


class Negative(SpeedRmse):
    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return super().finish(sums, count, epsilon) - 1.0


class Centred(SpeedRmse):
    """Is smallest where the simulation is a tenth too fast."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.speed - 1.1 * frames.measured_speed).square(),)


class Relative(SpeedRmse):
    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return ((frames.speed / frames.measured_speed - 1.0).square(),)


class Heedless(SpeedRmse):
    """Takes the mean over all frames, whether they count or not."""

    def __call__(
        self, frames: FrameValues, counted: Tensor, *, dim: int = 0, epsilon: float = 0.0
    ) -> Tensor:
        return super().__call__(frames, torch.ones_like(frames.speed), dim=dim, epsilon=epsilon)


class Comparing(SpeedRmse):
    """Looks at the worst trajectory of the batch."""

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        loss = super().finish(sums, count, epsilon)
        return loss / loss.max()


class Numbering(SpeedRmse):
    """Weighs the trajectories of a batch by their place."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        (term,) = super().terms(frames)
        place = torch.arange(term.shape[1], dtype=term.dtype) if term.dim() == 3 else 0.0
        return (term * (1.0 + place)[:, None] if term.dim() == 3 else term,)


class Drifting(SpeedRmse):
    """Sums over time itself, in what it takes for the dimension of time."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        return (((frames.speed - frames.measured_speed).cumsum(0)).square(),)


class Growing(SpeedRmse):
    """Returns another number of terms for one frame."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        (term,) = super().terms(frames)
        return (term,) if term.dim() == 3 else (term, term)


class Double(SpeedRmse):
    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return super().finish(sums, count, epsilon).double()


class Detached(SpeedRmse):
    """Hides half of its slope."""

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        error = frames.speed - frames.measured_speed
        return (error * error.detach(),)


class Vertical(SpeedRmse):
    """Ignores epsilon."""

    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        return root_mean_square(sums[0], count)


class Overwriting(SpeedRmse):
    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        if frames.speed.requires_grad:
            return super().terms(frames)
        return (frames.speed.sub_(frames.measured_speed).square(),)


class Misnamed(SpeedRmse):
    metric = "rmse_gap"


BROKEN: dict[str, tuple[Objective, Any, str]] = {
    "silent": (Silent(), first.says_its_unit_and_its_signals, "says the unit"),
    "blind": (Blind(), first.says_its_unit_and_its_signals, "reads the speed or the gap"),
    "secretive": (Secretive(), first.reads_only_the_signals_it_names, "add what `terms` reads"),
    "negative": (Negative(), first.a_loss_is_finite_and_never_negative, "never negative"),
    "centred": (Centred(), checks.a_perfect_simulation_has_the_lowest_loss, "a lower loss"),
    "relative": (Relative(), checks.a_standing_driver_has_a_finite_loss, "stand in a queue"),
    "heedless": (Heedless(), checks.frames_that_do_not_count_change_nothing, "anything finite"),
    "comparing": (Comparing(), checks.a_batch_equals_the_loop_over_it, "stands beside it"),
    "numbering": (Numbering(), checks.the_order_in_the_batch_does_not_matter, "its place"),
    "drifting": (Drifting(), checks.time_may_be_any_dimension, "which dimension is time"),
    "drifting in parts": (Drifting(), checks.parts_add_up_to_the_whole, "frame by frame"),
    "growing": (Growing(), checks.one_frame_needs_no_dimension_of_time, "as many tensors"),
    "misnamed": (Misnamed(), checks.it_is_the_metric_that_it_names, "must be one"),
    "double": (Double(), first.float32_agrees_with_float64, "computes in the dtype"),
    "detached": (Detached(), checks.gradients_are_right, "Jacobian mismatch"),
    "vertical": (Vertical(), checks.the_slope_at_a_perfect_simulation_is_finite, "epsilon"),
    "overwriting": (Overwriting(), checks.what_it_is_given_stays_as_it_is, "in place"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    with pytest.raises((AssertionError, RuntimeError), match=sentence):
        check(component)


def test_every_statement_has_an_objective_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


def test_a_good_objective_holds_all_of_them() -> None:
    check_contract(TheilInequality())
