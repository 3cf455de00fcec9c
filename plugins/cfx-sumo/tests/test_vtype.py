"""`sumo_vtype`: SUMO's models by their names, and what is wrong with one before SUMO is asked."""

from __future__ import annotations

import re

import pytest
import torch

from cfx.app.cli import main
from cfx.core.registry import create
from cfx.errors import ConfigError, ParameterError
from cfx_sumo.vtype import SumoVType

TAU = {"tau": {"low": 0.5, "high": 3.0, "default": 1.0}}


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
        create("model", {"name": "sumo_vtype", **settings})


def test_a_vtype_has_no_equations_here() -> None:
    model = create("model", {"name": "sumo_vtype", "parameters": TAU})
    assert isinstance(model, SumoVType)
    with pytest.raises(ConfigError, match="add simulator=sumo"):
        model.next_speed(None, None, {}, 0.1)  # type: ignore[arg-type]  # it looks at nothing


def test_its_parameters_are_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["model=sumo_vtype", "--cfg", "job", "--package", "model"]) == 0
    assert re.search(r"^parameters: null$", capsys.readouterr().out, flags=re.MULTILINE)
