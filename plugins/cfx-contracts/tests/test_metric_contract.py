"""Each statement of the contract fails for a metric that breaks it, and says so."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cfx.core.contract import Check, NotApplicable
from cfx.evaluation.metrics import contract as first
from cfx.evaluation.metrics.base import Metric, Trajectories
from cfx.evaluation.metrics.errors import MaeSpeed, RmseSpeed
from cfx_contracts import metrics as checks


class OfFrames(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        return (trajectories.speed - trajectories.measured_speed).abs()


class Infinite(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        return super().compute(trajectories) / 0.0


class Unmasked(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        return (trajectories.speed - trajectories.measured_speed).abs().mean(1)


class Relative(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        values = super().compute(trajectories)
        return values / values.mean()


class Ranked(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        values = super().compute(trajectories)
        return values + torch.arange(len(values))


class Offset(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        return super().compute(trajectories) + 0.01


class Fragile(RmseSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        values = super().compute(trajectories)
        return values + float(values.dtype == torch.float32)


class Careless(MaeSpeed):
    def compute(self, trajectories: Trajectories) -> Tensor:
        trajectories.speed.sub_(trajectories.measured_speed)
        values = trajectories.speed.abs()
        return torch.where(trajectories.counted, values, 0.0).sum(1)


@pytest.mark.parametrize(
    ("check", "metric", "said"),
    [
        (first.a_metric_gives_one_number_for_each_pair, OfFrames, "a number for each pair"),
        (first.a_metric_gives_one_number_for_each_pair, Infinite, "is NaN, not infinite"),
        (checks.frames_that_do_not_count_do_not_matter, Unmasked, "the padding was not simulated"),
        (checks.a_batch_equals_the_loop_over_it, Relative, "the pairs that are measured beside it"),
        (checks.the_order_of_the_pairs_does_not_matter, Ranked, "its place among the others"),
        (checks.a_simulation_without_error_has_none, Offset, "must be 0 for the recording"),
        (checks.single_precision_agrees_with_double, Fragile, "single precision"),
        (checks.inputs_stay_as_they_are, Careless, "`compute` changed `speed`"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_metric_that_breaks_a_statement_is_told(
    check: Check, metric: type[Metric], said: str
) -> None:
    with pytest.raises(AssertionError, match=said):
        check(metric())
    check(RmseSpeed())


def test_what_is_no_error_need_not_be_zero() -> None:
    class Gap(RmseSpeed):
        is_error = False

    with pytest.raises(NotApplicable):
        checks.a_simulation_without_error_has_none(Gap())
