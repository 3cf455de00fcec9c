from __future__ import annotations

import pytest
import torch

from cfx.contracts import ModelContract
from cfx.core import registry
from cfx.core.component import validate
from cfx.core.errors import ConfigError, ParameterError
from cfx.models.idm_sumo import IdmSumo
from cfx.models.krauss import Krauss
from cfx.models.krauss_sumo import KraussSumo
from cfx.models.sumo_vtype import SumoVType, SumoVTypeSettings
from cfx.models.w99 import W99

TAU = {"tau": {"low": 0.5, "high": 3.0, "default": 1.0}}


class TestKraussSumo(ModelContract):
    @pytest.fixture
    def model(self) -> KraussSumo:
        return KraussSumo()


class TestIdmSumo(ModelContract):
    @pytest.fixture
    def model(self) -> IdmSumo:
        return IdmSumo()


def test_krauss_sumo_keeps_its_time_gap_behind_a_steady_leader() -> None:
    from cfx.models.base import Leader
    from cfx.simulation.rollout import simulate
    from cfx.simulation.trajectory import Start

    time = torch.arange(3000, dtype=torch.float64) * 0.1
    speed = torch.full_like(time, 15.0)
    leader = Leader(
        15.0 * time, speed, torch.zeros_like(time), torch.tensor(5.0, dtype=torch.float64)
    )
    start = Start(*(torch.tensor(x, dtype=torch.float64) for x in (-80.0, 15.0, 0.0)))
    gap = simulate(KraussSumo(), {"tau": 1.4}, leader, start, 0.1).gap[-1]
    assert gap.item() == pytest.approx(2.5 + 1.4 * 15.0, abs=0.01)


def test_a_vtype_has_the_attributes_that_the_config_names_and_no_others() -> None:
    model = SumoVType(
        car_follow_model="Krauss", parameters=TAU, attributes={"sigma": 0.3, "accel": 2}
    )
    assert model.space.names == ("tau",)
    assert (model.space["tau"].unit, model.space["tau"].high) == ("s", 3.0)
    kind = model.sumo_vtype({"tau": torch.tensor(1.0)})
    assert kind.car_follow_model == "Krauss"
    assert kind.attributes == {"tau": torch.tensor(1.0), "sigma": "0.3", "accel": "2.0"}


def test_a_drive_is_drawn_at_random_only_where_it_is_asked_for() -> None:
    p = {"tau": torch.tensor(1.0)}
    assert SumoVType(parameters=TAU).sumo_vtype(p).attributes["sigmagap"] == "0"
    assert (
        SumoVType(parameters=TAU, attributes={"sigmagap": 0.1}).sumo_vtype(p).attributes["sigmagap"]
        == "0.1"
    )


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({}, r"model.parameters: a value is required"),
        ({"parameters": {}}, r"give the parameters, such as model.parameters='\{tau: "),
        (
            {"parameters": {"tau": {"low": 0.5, "high": 3}}},
            "model.parameters.tau: give low, high and default",
        ),
        (
            {"parameters": TAU, "attributes": {"tau": 1}},
            "model.attributes.tau: it is among model.parameters too",
        ),
        ({"parameters": {"tau": TAU["tau"] | {"tuned": False}}}, "no parameter is tuned"),
    ],
)
def test_what_is_wrong_with_a_vtype_is_said_before_sumo_is_asked(
    settings: dict[str, object], sentence: str
) -> None:
    with pytest.raises((ConfigError, ParameterError), match=sentence):
        registry.create("model", {"name": "sumo_vtype", **settings})


def test_a_vtype_has_no_equations_here() -> None:
    model = registry.create("model", {"name": "sumo_vtype", "parameters": TAU})
    assert isinstance(model, SumoVType)
    with pytest.raises(ConfigError, match="add simulator=sumo"):
        model.next_speed(None, None, {}, 0.1)  # type: ignore[arg-type]  # it looks at nothing


def test_the_node_asks_for_the_parameters() -> None:
    from cfx.app.nodes import render

    assert "parameters: null  # required" in render(SumoVType, "sumo_vtype")
    with pytest.raises(ConfigError, match="a value is required"):
        validate(SumoVTypeSettings, {}, where="model")


@pytest.mark.parametrize(
    "model",
    [
        Krauss(),
        Krauss(variant="sumo"),
        Krauss(parameters={"t_i": {"default": 0.0, "tuned": False}}),
        W99(variant="vissim"),
    ],
)
def test_a_variant_that_sumo_does_not_have_says_what_it_has(model: Krauss | W99) -> None:
    with pytest.raises(ConfigError, match="simulator=sumo: SUMO has model="):
        model.sumo_vtype(model.space.unpack(model.space.defaults()))
