"""Each statement of the contract fails for a model that breaks it, and says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal

import pytest
import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.core.contract import violations
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models import contract as first
from cfx.models.base import DrivingModel
from cfx.models.krauss import Krauss, KraussSettings
from cfx_contracts import models as checks

Step = Callable[..., Any]


def model(change: Step, **attributes: object) -> DrivingModel:
    """Krauss's model whose next speed is changed by `change(speed, follower, leader, p)`."""

    def next_speed(self: Krauss, follower: Any, leader: Any, p: Any, dt: float) -> Any:
        return change(Krauss.next_speed(self, follower, leader, p, dt), follower, leader, p)

    return type("Broken", (Krauss,), {"next_speed": next_speed, **attributes})()


class Remembering(Krauss):
    def next_speed(self, *state: Any) -> Tensor:
        self.calls = getattr(self, "calls", 0) + 1
        return super().next_speed(*state) + self.calls


class Meddling(Krauss):
    def next_speed(self, follower: Any, *rest: Any) -> Tensor:
        speed = super().next_speed(follower, *rest)
        follower.speed.add_(0.01)
        return speed


class Forgetting(Krauss):
    memory_size = 2

    def next_memory(self, follower: Any, *rest: Any) -> Tensor:
        return follower.memory[..., :1]


class Stubborn(Krauss):
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.space = self.parameters


class Undocumented(Krauss):
    parameters = ParameterSpace.of(
        *(Parameter(p.name, p.unit, p.low, p.high, p.default, p.meaning) for p in Krauss.parameters)
    )


class Dimensionless(Krauss):
    parameters = ParameterSpace.of(
        *(
            Parameter(p.name, "", p.low, p.high, p.default, p.meaning, p.source)
            for p in Krauss.parameters
        )
    )


class Anonymous(Krauss):
    reference = ""


class Exploding(Krauss):
    def next_speed(self, follower: Any, *rest: Any) -> Tensor:
        return 1.2 * follower.speed + 1.0


def root_of_gap(speed: Tensor, follower: Any, leader: Any, _: Any) -> Tensor:
    gap = leader.position - leader.length - follower.position
    return speed + torch.where(gap > 0, gap.clamp(min=0).sqrt(), 0.0)


def krauss_gap(speed: Tensor, p: Any) -> Tensor:
    return speed * p["t_r"] + p["min_gap"]


class Overgrown(Krauss):
    """Declares a parameter that no equation reads, as tuned."""

    parameters = ParameterSpace.of(
        *Krauss.parameters, Parameter("mood", "1", 0.0, 1.0, 0.5, "how they feel", "made up")
    )


class MoodySettings(KraussSettings):
    style: Literal["moody", "calm"] = "moody"


class Moody(Overgrown):
    """Reads it with its default settings only."""

    schema: ClassVar[type[Settings]] = MoodySettings

    def next_speed(self, follower: Any, leader: Any, p: Any, dt: float) -> Tensor:
        speed = super().next_speed(follower, leader, p, dt)
        return speed * p["mood"] if self.settings.style == "moody" else speed


class Declared(Moody):
    """Says so."""

    parameters = ParameterSpace.of(
        *Krauss.parameters,
        replace(Overgrown.parameters["mood"], used_with=("style", "moody")),
    )


EXTREME = checks.speeds_are_finite_and_not_negative_at_every_extreme
SHAPE = first.keeps_shape_dtype_and_device
BROKEN = {
    "NaN": (model(lambda v, f, *_: v / (f.speed - f.speed)), EXTREME, "negative or infinite speed"),
    "negative": (model(lambda v, *_: v - 1), EXTREME, "negative or infinite speed"),
    "shape": (model(lambda v, *_: v[..., None]), SHAPE, r"must give \(\*batch,\)"),
    "dtype": (model(lambda v, *_: v.float()), SHAPE, "computes in the dtype"),
    "braking": (
        model(lambda v, *_: v - 30),
        first.steps_are_finite_and_never_negative,
        "must give finite speeds, not negative",
    ),
    "memory": (Forgetting(), SHAPE, "memory_size"),
    "state": (Remembering(), first.is_pure, "keeps no state"),
    "in place": (Meddling(), first.is_pure, "changes follower.speed in place"),
    "mean": (
        model(lambda v, f, *_: v + 0.1 * f.speed.mean()),
        checks.a_batch_equals_the_loop_over_it,
        "differently alone",
    ),
    "sum": (
        model(lambda v, f, _, p: v + 0 * p["t_r"].sum()),
        checks.a_bad_neighbour_does_no_harm,
        "not reach the others",
    ),
    "first": (
        model(lambda v, *_: v[..., :1].expand(v.shape)),
        checks.leaders_and_parameters_broadcast,
        "changes the numbers",
    ),
    "cancels": (
        model(lambda v, *_: (v + 1e7) - 1e7),
        checks.single_precision_agrees_with_double,
        "cancels",
    ),
    "gradient": (
        model(lambda v, *_: v.detach() + 0 * v),
        checks.gradients_are_right,
        "gradients differ",
    ),
    "root": (model(root_of_gap), checks.gradients_are_finite_at_every_extreme, "not finite"),
    "explodes": (
        Exploding(),
        checks.no_rollout_leaves_what_is_finite,
        "infinity or NaN|absurd speeds",
    ),
    "blind": (
        model(lambda v, f, *_: f.speed, collision_free=True),
        checks.collision_free_as_claimed,
        "hits a leader",
    ),
    "ignores": (
        model(lambda v, f, *_: f.speed),
        checks.has_a_constant_baseline_as_claimed,
        "set `has_constant_baseline = False`",
    ),
    "stubborn": (
        Stubborn(),
        checks.constants_can_be_tuned_and_tuned_parameters_fixed,
        "must turn a constant",
    ),
    "overgrown": (
        Overgrown(),
        checks.every_tuned_parameter_changes_a_trajectory,
        "mood changes no trajectory, from bound",
    ),
    "unread": (
        Overgrown(),
        first.reads_the_parameters_that_it_declares,
        "next_speed never reads mood",
    ),
    "undeclared": (
        model(lambda v, *args: v * args[-1]["mood"]),
        first.reads_the_parameters_that_it_declares,
        "reads the parameter 'mood', which is not in its `parameters`",
    ),
    "no source": (Undocumented(), checks.every_parameter_says_what_it_is, "has no source"),
    "no unit": (Dimensionless(), checks.every_parameter_says_what_it_is, "has no unit"),
    "no reference": (Anonymous(), checks.every_parameter_says_what_it_is, "set `reference`"),
    "branch": (
        model(lambda v, *_: v if v.sum() > 0 else 2 * v),
        checks.can_be_compiled_as_one_graph,
        "instead of if",
    ),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    with pytest.raises(AssertionError, match=sentence):
        check(component)


def test_a_parameter_that_a_variant_does_not_use_is_told_unless_it_is_declared() -> None:
    check = checks.every_tuned_parameter_changes_a_trajectory
    with pytest.raises(AssertionError, match="mood changes no trajectory with style=calm"):
        check(Moody())
    check(Declared())
    assert "mood" in Declared().space.names
    assert "mood" not in Declared(style="calm").space.names


def test_another_equilibrium_is_told() -> None:
    checks.keeps_its_equilibrium(Krauss(), krauss_gap)
    with pytest.raises(AssertionError, match="the speed must stay"):
        checks.keeps_its_equilibrium(model(lambda v, *_: v + 0.1), krauss_gap)


def test_every_statement_has_a_model_that_breaks_it() -> None:
    shown = {check for _, check, _ in BROKEN.values()} | {checks.keeps_its_equilibrium}
    assert shown == set(checks.CONTRACT.checks)


def test_a_component_that_raises_is_reported_and_not_fatal() -> None:
    raising = model(lambda v, f, *_: torch.stack([v, f.speed]).view(3, -1))
    found = dict(violations(raising, checks.CONTRACT.quick))
    assert "the component raised RuntimeError" in found["is_pure"]
