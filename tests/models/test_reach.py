"""How far a policy of offsets may move a parameter: within the bounds of constant ones, beyond, or not at all."""

from __future__ import annotations

import pytest
import torch

from cfx import hydra_source, registry
from cfx.errors import ConfigError, ParameterError
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.offsets import moved


def test_reach_moves_bounds_outwards_for_policies_alone() -> None:
    model = Krauss(reach={"t_r": (0.001, 50.0)})
    assert (model.reach["t_r"].low, model.reach["t_r"].high) == (0.001, 50.0)
    assert model.space == Krauss().space
    assert model.reach["b"] == model.space["b"]


def test_reach_never_moves_bounds_inwards() -> None:
    model = W99(parameters={"cc8": {"high": 9.0}}, reach={"cc8": (0.05, 5.0)})
    assert (model.reach["cc8"].low, model.reach["cc8"].high) == (0.05, 9.0)
    assert W99().reach == W99().space


@pytest.mark.parametrize(
    ("reach", "message"),
    [
        ({"tr": (0.0, 1.0)}, "Did you mean 't_r'"),
        ({"t_r": (2.0, 1.0)}, r"model\.reach\.t_r=\[2\.0, 1\.0\]: the first must be below"),
        ({"t_r": None, "t_i": None}, "could move none"),
    ],
)
def test_a_wrong_reach_is_named(reach: dict[str, tuple[float, float] | None], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Krauss(reach=reach)


def test_a_reach_needs_both_ends() -> None:
    with pytest.raises(ConfigError, match=r"model\.reach\.t_r"):
        Krauss(reach={"t_r": (1.0,)})  # type: ignore[dict-item]  # what a user may write


def test_what_is_held_stays_at_its_base_whatever_a_network_answers() -> None:
    reach = Krauss(reach={"t_i": None}).reach
    base = reach.to_unit(torch.tensor([[1.5, 0.2], [3.0, 2.0]]).double())
    free = reach.free()
    assert free is not None
    found = moved(base, torch.tensor([[0.9, 0.9], [0.1, 0.1]]).double(), free)
    assert torch.equal(found[:, 1], base[:, 1])
    assert torch.equal(found[:, 0], moved(base, torch.tensor([[0.9], [0.1]]).double())[:, 0])
    assert Krauss().reach.free() is None


def test_the_preset_krauss_headway_holds_t_i() -> None:
    model = registry.create("model", hydra_source.plain(hydra_source.composed(["model=krauss_headway"]))["model"])
    assert isinstance(model, Krauss)
    assert model.space == Krauss().space
    assert [parameter.name for parameter in model.reach.tuned if parameter.held] == ["t_i"]


def test_w99_reaching_calibrates_the_constants_of_w99() -> None:
    model = registry.create("model", hydra_source.plain(hydra_source.composed(["model=w99_reaching"]))["model"])
    assert isinstance(model, W99)
    assert model.space == W99().space
    assert (model.reach["cc7"].high, model.reach["cc8"].low) == (3.0, 0.05)
