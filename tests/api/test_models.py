"""Models that a program defines are models like all others, until the program ends."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from torch import Tensor

import cfx
from cfx.core import registry
from cfx.errors import PluginError
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap


@pytest.fixture(autouse=True)
def _forgets_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets no other test know the models that these define."""
    monkeypatch.setattr(registry, "_of_this_process", {})


def define(pull: float) -> type[DrivingModel]:
    """Defines the model `mine`, as a cell of a notebook does."""

    @cfx.model("mine")
    class Mine(cfx.plugin.DrivingModel):
        """Approaches a gap."""

        parameters = cfx.plugin.ParameterSpace.of(
            cfx.plugin.Parameter("s0", "m", 1.0, 50.0, 20.0, "gap")
        )

        def next_speed(
            self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
        ) -> Tensor:
            gap = bumper_gap(follower, leader)
            wanted = pull * (gap - p["s0"]) + leader.speed - follower.speed
            return (follower.speed + wanted * dt).clamp(min=0.0)

    return Mine


def test_a_model_of_ones_own_is_calibrated_by_its_name() -> None:
    cls = define(0.1)
    assert cfx.get("model", "mine") is cls
    assert registry.entry("model", "mine").distribution == registry.THIS_PROCESS
    pairs = cfx.read(dataset="synthetic", pairs=2, frames=200)
    fit = cfx.calibrate(pairs, "mine", optimizer="random")
    assert list(fit.parameters) == ["s0"]
    assert "model=mine" in cfx.config(model="mine").command


def test_a_model_that_is_defined_again_is_another_one() -> None:
    pairs = cfx.read(dataset="synthetic", pairs=2, frames=200)
    ends = []
    for pull in (0.02, 0.5):
        cls = define(pull)
        assert cfx.get("model", "mine") is cls
        fit = cfx.calibrate(pairs, "mine", optimizer="random")
        ends.append(
            fit.losses.loc[fit.losses["method"] == "driver_specific", "train_rmse_speed"].tolist()
        )
    assert ends[0] != ends[1]
    assert define(0.1)().identity()["code"] != define(0.1)().identity()["code"]


def test_an_installed_name_and_a_broken_class_are_refused() -> None:
    with pytest.raises(PluginError, match=r"model=idm means it; choose another name"):
        cfx.model("idm")(define(0.1))

    class Empty(cfx.plugin.DrivingModel):
        parameters = cfx.plugin.ParameterSpace.of(
            cfx.plugin.Parameter("s0", "m", 1.0, 50.0, 20.0, "gap")
        )

    with pytest.raises(PluginError, match="does not implement next_speed"):
        cfx.model("empty")(Empty)
    with pytest.raises(PluginError, match="model=three: a model is a class, not 3"):
        cfx.model("three")(3)  # type: ignore[type-var]  # what is tested
