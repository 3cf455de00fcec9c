"""Plugins of the version before: their names of a model's attributes work, with a warning."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor

from cfx import DrivingModel, Follower, Leader, Parameter, ParameterSpace
from cfx.models.krauss import Krauss
from cfx.models.regimes import below, up_to

SPACE = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap", "here"))


def test_a_model_that_says_follows_is_understood() -> None:
    with pytest.warns(DeprecationWarning, match="follows is now called has_constant_baseline"):

        class Old(DrivingModel):
            parameters = SPACE
            follows = False

            def next_speed(self, follower, leader, p, dt):
                return follower.speed

    assert not Old().has_constant_baseline
    assert Krauss().has_constant_baseline


def switching() -> type[DrivingModel]:
    class Old(DrivingModel):
        parameters = SPACE

        def next_speed(self, follower, leader, p, dt):
            slow = 0.5 * follower.speed
            return below(
                p["tau"], follower.speed, slow, follower.speed, scale=1.0, softness=self.softness
            )

    return Old


def step(model: DrivingModel) -> Tensor:
    follower = torch.tensor([0.5, 2.0, 4.0], dtype=torch.float64)
    state = Follower(follower, follower, follower, follower[:, None])
    return model.next_speed(
        state,
        Leader(follower, follower, follower, follower),
        {"tau": follower.new_tensor(1.0)},
        0.1,
    )


def test_a_step_that_reads_softness_gets_the_temperature() -> None:
    model = switching()()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        exact = step(model)
        soft = step(model.at_temperature(1.0))
    texts = " ".join(str(one.message) for one in said)
    assert "Old.softness is now called temperature" in texts
    assert "softness= is now called temperature=" in texts
    assert exact.tolist() == [0.5, 1.0, 2.0]
    assert not torch.equal(exact, soft)


def test_such_a_step_compiles_as_one_graph_without_a_word() -> None:
    compiled = torch.compile(switching()().next_speed, fullgraph=True, backend="aot_eager")
    x = torch.tensor([0.5, 2.0], dtype=torch.float64)
    found = compiled(
        Follower(x, x, x, x[:, None]), Leader(x, x, x, x), {"tau": x.new_tensor(1.0)}, 0.1
    )
    assert found.tolist() == [0.5, 1.0]


def test_an_override_of_smoothed_is_what_training_calls() -> None:
    with pytest.warns(DeprecationWarning, match="smoothed is now called at_temperature"):

        class Old(switching()):
            def smoothed(self, softness):
                model = super().smoothed(softness)
                model.seen = softness
                return model

    with pytest.warns(DeprecationWarning, match="is now called"):
        model = Old().at_temperature(0.5)
    assert model.seen == 0.5
    assert model.temperature == 0.5


def test_the_earlier_names_are_there_on_every_model() -> None:
    model = Krauss(adaptation_bounds={"t_r": (0.001, 50.0)})
    with pytest.warns(DeprecationWarning, match="reach is now called adaptation_space"):
        assert model.reach == model.adaptation_space
    with pytest.warns(DeprecationWarning, match="is now called"):
        soft = model.smoothed(0.3)
    assert soft.temperature == 0.3
    with pytest.warns(DeprecationWarning, match="is now called"):
        soft.softness = 0.2
    assert soft.temperature == 0.2


def test_up_to_takes_softness_too() -> None:
    one, two = torch.tensor([1.0, 2.0], dtype=torch.float64)
    with pytest.warns(DeprecationWarning, match="is now called"):
        assert up_to(one, one, one, two, scale=1.0, softness=0.0) == one
