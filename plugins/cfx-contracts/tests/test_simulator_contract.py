"""The contract of a simulator fails where a simulator breaks it, and says why."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch

from cfx.errors import ConfigError, SumoError
from cfx.models.base import DrivingModel, Follower
from cfx.models.krauss import Krauss
from cfx.simulation import contract as first
from cfx.simulation.base import Simulator, Stepper
from cfx.simulation.rollout import MemorySimulator, MemoryStepper
from cfx_contracts import check_contract
from cfx_contracts import simulators as checks

MakeStepper = Callable[[DrivingModel, float], Any]


class With(MemorySimulator):
    """A simulator that takes other steps than cfx's own."""

    def __init__(self, make: MakeStepper) -> None:
        super().__init__()
        self._make = make

    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        stepper: Stepper = self._make(model, dt)
        return stepper


class Careless(MemorySimulator):
    def require(self, model: DrivingModel) -> None:
        """Lets everything through."""


class Unlike(MemoryStepper):
    differentiable = False


class Single(MemoryStepper):
    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        return end, position.float(), speed.float()


class Wishful(MemoryStepper):
    """Says that it accelerates as it did before."""

    def advance(self, follower: Follower, *others: Any) -> Any:
        end, position, speed = super().advance(follower, *others)
        return end._replace(acceleration=follower.acceleration), position, speed


class Restless(MemoryStepper):
    def advance(self, follower: Follower, leader: Any, p: Any) -> Any:
        end, position, speed = super().advance(follower, leader, p)
        if len(position) == 0:
            end = end._replace(speed=end.speed + 1.0)
        return end, position, speed


class Jumping(MemoryStepper):
    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        if len(position):
            position = position + torch.linspace(0.0, 9.0, len(position))[:, None]
        return end, position, speed


class Crowding(MemoryStepper):
    """Followers slow each other down."""

    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        return end, position, speed * (1.0 - 0.001 * speed.shape[-1])


class Foreseeing(MemoryStepper):
    def advance(self, follower: Follower, leader: Any, p: Any) -> Any:
        if len(leader.speed):
            ahead = leader.speed[-1:].expand_as(leader.speed)
            leader = leader._replace(speed=0.9 * leader.speed + 0.1 * ahead)
        return super().advance(follower, leader, p)


class Forgetting(MemoryStepper):
    """Begins each call at half the speed."""

    def advance(self, follower: Follower, *others: Any) -> Any:
        return super().advance(follower._replace(speed=0.5 * follower.speed), *others)


class Random(MemoryStepper):
    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        return end, position, speed + 1e-9 * torch.rand_like(speed)


class Overwriting(MemoryStepper):
    def advance(self, follower: Follower, leader: Any, p: Any) -> Any:
        result = super().advance(follower, leader, p)
        if len(leader.speed):
            leader.speed[0] += 1.0
        return result


class Closing(MemoryStepper):
    """Takes no steps as before once it was closed."""

    slower = 1.0

    def close(self) -> None:
        self.slower = 0.5

    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        return end, position, self.slower * speed


class Nameless(MemoryStepper):
    _count = itertools.count()

    def __init__(self, model: DrivingModel, dt: float) -> None:
        super().__init__(model, dt)
        self._number = next(self._count)

    def identity(self) -> str:
        return f"number {self._number}"


class Cutting(MemoryStepper):
    """Gives speeds that no longer know where they come from."""

    def advance(self, *inputs: Any) -> Any:
        end, position, speed = super().advance(*inputs)
        return end, position, speed.detach() + 0.0 * sum(p.sum() for p in inputs[2].values())


class Narrow(MemoryStepper):
    """Takes a batch of one dimension alone."""

    def advance(self, follower: Follower, leader: Any, p: Any) -> Any:
        end, position, speed = super().advance(follower, leader, p)
        if position.dim() > 2:
            position, speed = position.flatten(1), speed.flatten(1)
        return end, position, speed


BROKEN: dict[str, tuple[Simulator, Any, str]] = {
    "careless": (Careless(), checks.refuses_what_it_cannot_drive, "must raise a ConfigError"),
    "no stepper": (
        With(lambda model, dt: None),
        first.makes_a_stepper_for_the_model,
        "returns a NoneType and no Stepper",
    ),
    "another model": (
        With(lambda model, dt: MemoryStepper(Krauss(), dt)),
        first.makes_a_stepper_for_the_model,
        "must be the model it was made for",
    ),
    "unlike": (With(Unlike), first.makes_a_stepper_for_the_model, "must agree"),
    "single": (With(Single), checks.keeps_shape_dtype_and_device, "computes in the dtype"),
    "single here": (
        With(Single),
        first.steps_in_this_process_keep_shape_and_dtype,
        "computes in the dtype",
    ),
    "wishful": (With(Wishful), checks.ends_where_the_last_step_led, "realised"),
    "restless": (With(Restless), checks.no_steps_change_nothing, "stays as it is"),
    "jumping": (With(Jumping), checks.positions_and_speeds_belong_together, "two stories"),
    "crowding": (With(Crowding), checks.followers_are_independent, "depend on shards"),
    "narrow": (With(Narrow), checks.leaders_and_parameters_broadcast, "must broadcast"),
    "foreseeing": (With(Foreseeing), checks.sees_no_later_frame_of_the_leader, "no future"),
    "forgetting": (With(Forgetting), checks.parts_give_the_whole, "what one call gives"),
    "random": (With(Random), checks.the_same_again_gives_the_same, "to the last bit"),
    "overwriting": (With(Overwriting), checks.the_inputs_stay_as_they_are, "in place"),
    "closing": (With(Closing), checks.goes_on_after_it_was_closed, "start them again"),
    "nameless": (With(Nameless), first.says_what_results_depend_on, "one `identity`"),
    "cutting": (With(Cutting), checks.gradients_are_as_claimed, "all gradients are 0"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    simulator, check, sentence = BROKEN[broken]
    with pytest.raises(AssertionError, match=sentence):
        check(simulator)


def test_every_statement_has_a_simulator_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


def test_what_claims_no_gradients_must_refuse_to_give_them() -> None:
    class Silent(With):
        differentiable = False

    with pytest.raises(AssertionError, match="must raise a CfxError"):
        checks.gradients_are_as_claimed(Silent(Unlike))


def test_what_is_not_installed_is_left_out() -> None:
    class Missing(MemorySimulator):
        def require(self, model: DrivingModel) -> None:
            raise SumoError("it is not installed")

    check_contract(Missing())


def test_a_model_of_its_own_can_be_given() -> None:
    class Picky(MemorySimulator):
        def require(self, model: DrivingModel) -> None:
            if not isinstance(model, Own):
                raise ConfigError("only its own")

    class Own(Krauss):
        pass

    check_contract(Picky())
    check_contract(Picky(), model=Own())
