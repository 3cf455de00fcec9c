"""How far a policy of offsets may move a parameter: within calibration's bounds, beyond, or not."""

from __future__ import annotations

import pytest
import torch

from cfx.app import hydra_source
from cfx.core import registry
from cfx.errors import ConfigError, ParameterError
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.heads.offset import moved


def test_adaptation_bounds_move_bounds_outwards_for_policies_alone() -> None:
    model = Krauss(adaptation_bounds={"t_r": (0.001, 50.0)})
    assert (model.adaptation_space["t_r"].low, model.adaptation_space["t_r"].high) == (0.001, 50.0)
    assert model.space == Krauss().space
    assert model.adaptation_space["b"] == model.space["b"]


def test_adaptation_bounds_never_move_bounds_inwards() -> None:
    model = W99(parameters={"cc8": {"high": 9.0}}, adaptation_bounds={"cc8": (0.05, 5.0)})
    assert (model.adaptation_space["cc8"].low, model.adaptation_space["cc8"].high) == (0.05, 9.0)
    assert W99().adaptation_space == W99().space


@pytest.mark.parametrize(
    ("adaptation_bounds", "message"),
    [
        ({"tr": (0.0, 1.0)}, "Did you mean 't_r'"),
        (
            {"t_r": (2.0, 1.0)},
            r"model\.adaptation_bounds\.t_r=\[2\.0, 1\.0\]: the first must be below",
        ),
        ({"t_r": None, "t_i": None}, "could move none"),
        ({"t_r": (-1.0, 2.0)}, r"adaptation_bounds\.t_r: -1 is negative"),
    ],
)
def test_wrong_adaptation_bounds_are_named(
    adaptation_bounds: dict[str, tuple[float, float] | None], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        Krauss(adaptation_bounds=adaptation_bounds)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"t_r": {"low": -1.0}},
            r"model\.parameters\.t_r\.low: -1 is negative, .*own bounds of t_r",
        ),
        ({"t_r": {"high": 1500.0}}, r"t_r\.high: 1500 is more than 100 times as far"),
        ({"t_r": {"low": 5.0, "high": 1.0}}, r"parameter t_r: low \(5\.0\) must be below high"),
    ],
)
def test_bounds_that_no_driver_can_have_are_refused(
    change: dict[str, dict[str, float]], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        Krauss(parameters=change)


def test_adaptation_bounds_need_both_ends() -> None:
    with pytest.raises(ConfigError, match=r"model\.adaptation_bounds\.t_r"):
        Krauss(adaptation_bounds={"t_r": (1.0,)})  # type: ignore[dict-item]  # what a user may write


def test_what_is_frozen_stays_at_its_base_whatever_a_network_answers() -> None:
    adaptation_space = Krauss(adaptation_bounds={"t_i": None}).adaptation_space
    base = adaptation_space.to_unit(torch.tensor([[1.5, 0.2], [3.0, 2.0]]).double())
    adaptable = adaptation_space.adaptable()
    assert adaptable is not None
    found = moved(base, torch.tensor([[0.9, 0.9], [0.1, 0.1]]).double(), adaptable)
    assert torch.equal(found[:, 1], base[:, 1])
    assert torch.equal(found[:, 0], moved(base, torch.tensor([[0.9], [0.1]]).double())[:, 0])
    assert Krauss().adaptation_space.adaptable() is None


def test_the_preset_krauss_headway_freezes_t_i() -> None:
    model = registry.create(
        "model", hydra_source.plain(hydra_source.composed(["model=krauss_headway"]))["model"]
    )
    assert isinstance(model, Krauss)
    assert model.space == Krauss().space
    assert [parameter.name for parameter in model.adaptation_space.tuned if parameter.frozen] == [
        "t_i"
    ]


def test_w99_wide_calibrates_the_constants_of_w99() -> None:
    model = registry.create(
        "model", hydra_source.plain(hydra_source.composed(["model=w99_wide"]))["model"]
    )
    assert isinstance(model, W99)
    assert model.space == W99().space
    assert (model.adaptation_space["cc7"].high, model.adaptation_space["cc8"].low) == (3.0, 0.05)
