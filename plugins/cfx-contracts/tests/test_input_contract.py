"""Each statement of the contract fails for an input of policies that breaks it, and says so."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.contract import Check, NotApplicable
from cfx.data.signals import SIGNALS, Signal
from cfx.policies.history import History
from cfx.policies.inputs.base import PolicyInput
from cfx.policies.inputs.motion import LeaderSpeed, TimeHeadway
from cfx_contracts import check_contract
from cfx_contracts import inputs as checks

ROAD_GRADE = Signal("road_grade", "", "rise over run", "road_grade", low=-0.2, high=0.2)


class Mean(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return super().values(history).mean(-1)


class Double(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return super().values(history).double()


class Undeclared(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return history["gap"] - 0.0 * history["leader_speed"]


class Relative(TimeHeadway):
    def values(self, history: History) -> Tensor:
        values = super().values(history)
        return values / values.mean()


class Pole(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return history["gap"] / history["follower_speed"]


class Overflowing(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return history["gap"].exp()


class Root(TimeHeadway):
    """Its values are fine, its gradient at the masked places is not."""

    def values(self, history: History) -> Tensor:
        gap = history["gap"]
        return torch.where(gap > 30.0, (gap - 30.0).sqrt(), 0.0)


class Coarse(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return super().values(history) + float(history["gap"].dtype == torch.float32)


class Careless(TimeHeadway):
    def values(self, history: History) -> Tensor:
        return history["gap"].sub_(1.0)


@pytest.mark.parametrize(
    ("check", "broken", "said"),
    [
        (checks.it_gives_one_number_for_each_frame, Mean, "a number for each frame"),
        (checks.it_gives_one_number_for_each_frame, Double, "in the dtype of what it is given"),
        (checks.it_reads_the_signals_that_it_declares, Undeclared, "reads 'leader_speed', which"),
        (checks.leading_dimensions_do_not_matter, Relative, "depend on the others'"),
        (checks.it_is_finite_at_standstill, Pole, "stand bumper to bumper"),
        (checks.it_is_finite_on_a_free_road, Overflowing, "where nobody is ahead"),
        (checks.it_is_differentiable, Root, "its gradient by gap is NaN"),
        (checks.single_precision_agrees_with_double, Coarse, "in single precision"),
        (checks.frames_stay_as_they_are, Careless, "`values` changed gap"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_an_input_that_breaks_a_statement_is_told(
    check: Check, broken: type[PolicyInput], said: str
) -> None:
    with pytest.raises(AssertionError, match=said):
        check(broken())
    check(TimeHeadway())


@pytest.mark.parametrize("name", registry.names("input"))
def test_every_input_keeps_the_contract(name: str) -> None:
    check_contract(registry.create("input", {"name": name}))


def test_inputs_that_read_further_signals_keep_it_too() -> None:
    class Slope(PolicyInput):
        meaning = "acceleration by which the road slows vehicles down"
        unit = "m/s2"
        signals = (ROAD_GRADE,)

        def values(self, history: History) -> Tensor:
            return 9.81 * history["road_grade"]

    check_contract(Slope())
    assert float(checks.history(Slope())["road_grade"].abs().max()) <= 0.2


def test_an_input_without_a_gap_has_no_free_road() -> None:
    with pytest.raises(NotApplicable):
        checks.it_is_finite_on_a_free_road(LeaderSpeed())
    assert SIGNALS["gap"].belongs_to == "follower"
