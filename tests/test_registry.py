"""The registry: metadata first, lazy, and unharmed by broken plugins."""

from __future__ import annotations

import importlib
import sys

import pytest

from cfx.core import registry
from cfx.errors import ConfigError, ParameterError, PluginError

MODEL = '''
    """A third party's model."""
    from pydantic import Field

    from cfx.plugin import DrivingModel, Parameter, ParameterSpace
    from cfx.models.base import ModelSettings

    class MineSettings(ModelSettings):
        mood: str = Field("calm", description="how it drives")
        map: str = Field(description="road map, a file")

    class Mine(DrivingModel):
        """Drives as I like."""

        schema = MineSettings
        parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time headway"))

        def next_speed(self, follower, leader, p, dt):
            return follower.speed + 0.0 * p["tau"]
'''


def test_every_kind_has_the_built_in_components_of_pyproject() -> None:
    assert set(registry.names("model")) >= {"krauss", "w99", "helly"}
    assert (
        set(registry.names("dataset"))
        == set(registry.names("data"))
        >= {"tidy", "pair_csv", "synthetic"}
    )
    built_in = {
        entry.name: entry
        for entry in registry.entries("policy")
        if entry.distribution == "cfx-driving"
    }
    assert set(built_in) >= {"default", "fixed", "gru", "lstm"}
    assert all(entry.version for entry in built_in.values())


def test_a_third_partys_model_is_listed_without_running_its_code_and_then_created(install) -> None:
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, {"mine_models.py": MODEL})
    assert "mine" in registry.names("model")
    assert "mine_models" not in sys.modules
    entry = registry.entry("model", "mine")
    assert (entry.distribution, entry.version, entry.package) == (
        "mine-models",
        "1.0",
        "mine_models",
    )
    assert not registry.is_loaded(entry)

    model = registry.create(
        "model", {"name": "mine", "map": "x.osm", "parameters": {"tau": {"high": 4.0}}}
    )
    assert registry.get("model", "mine") is type(model)
    assert registry.is_loaded(entry)
    assert model.space["tau"].high == 4.0  # type: ignore[attr-defined]  # a DrivingModel


def test_unknown_names_are_answered_with_the_nearest() -> None:
    with pytest.raises(PluginError, match=r"model=kraus: .*Did you mean 'krauss'\? Known: .*w99"):
        registry.get("model", "kraus")
    with pytest.raises(PluginError, match=r"model=IDM: .*Did you mean 'idm'\?"):
        registry.get("model", "IDM")
    with pytest.raises(PluginError, match=r"'modle'.*Did you mean 'model'"):
        registry.names("modle")


def test_a_name_that_two_distributions_claim_fails_only_when_it_is_asked_for(install) -> None:
    install(
        "first-models",
        {"cfx.models": {"mine": "first_models:Mine", "first": "first_models:Mine"}},
        {"first_models.py": MODEL},
    )
    install(
        "second-models",
        {"cfx.models": {"mine": "second_models:Mine"}},
        {"second_models.py": MODEL},
        version="2.0",
    )
    with pytest.raises(PluginError, match=r"first-models 1\.0 .*and second-models 2\.0"):
        registry.get("model", "mine")
    assert registry.get("model", "first").kind == "model"
    assert registry.get("model", "krauss").kind == "model"


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): pass\nraise Odd", "Odd"),
        ("import not_there_at_all", "ModuleNotFoundError: No module named 'not_there_at_all'"),
        ("def broken(:", "SyntaxError"),
        ("", "AttributeError: module 'bad_models' has no attribute 'Bad'"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_named_and_harms_nobody_else(
    install, code: str, cause: str
) -> None:
    install("bad-models", {"cfx.models": {"bad": "bad_models:Bad"}}, {"bad_models.py": code})
    assert "bad" in registry.names("model")
    assert registry.create("model", {"name": "krauss"}).kind == "model"
    with pytest.raises(
        PluginError, match=r"of the distribution bad-models 1\.0 cannot be imported"
    ) as caught:
        registry.get("model", "bad")
    assert cause in str(caught.value)
    assert caught.value.__cause__ is not None


def test_ctrl_c_while_a_plugin_is_imported_stays_ctrl_c(install) -> None:
    install(
        "slow-models",
        {"cfx.models": {"slow": "slow_models:Slow"}},
        {"slow_models.py": "raise KeyboardInterrupt"},
    )
    with pytest.raises(KeyboardInterrupt):
        registry.get("model", "slow")


@pytest.mark.parametrize(
    ("code", "complaint"),
    [
        ("Bad = 3", "is no class but int"),
        ("class Bad: pass", "does not extend cfx.models.base.DrivingModel"),
        ("from cfx.plugin import Optimizer as Bad", "does not extend cfx.models.base.DrivingModel"),
        (
            "from cfx.plugin import DrivingModel\nclass Bad(DrivingModel): pass",
            "does not implement next_speed",
        ),
        (
            "from cfx.plugin import DrivingModel\n"
            "class Bad(DrivingModel):\n  kind = 'optimizer'\n  def next_speed(self, *a): pass",
            "says kind='optimizer'",
        ),
        (
            "from cfx.plugin import DrivingModel\n"
            "class Bad(DrivingModel):\n  def next_speed(self, *a): pass",
            "must be a cfx.plugin.ParameterSpace",
        ),
        (
            "from cfx.plugin import DrivingModel\n"
            "class Bad(DrivingModel):\n  parameters = ['tau']\n  def next_speed(self, *a): pass",
            "must be a cfx.plugin.ParameterSpace, not list",
        ),
        (
            "from cfx.plugin import DrivingModel, ParameterSpace\n"
            "class Bad(DrivingModel):\n  parameters = ParameterSpace.of()\n"
            "  def next_speed(self, *a): pass",
            "at least one of its parameters must be tuned",
        ),
        (
            "from cfx.models.krauss import Krauss\nclass Bad(Krauss):\n  schema = dict",
            "its schema must be a subclass of cfx.plugin.Settings",
        ),
        (
            "from cfx.models.krauss import Krauss\nfrom cfx.plugin import Settings\n"
            "class Bad(Krauss):\n  schema = Settings",
            "its schema must extend cfx.models.base.ModelSettings",
        ),
        (
            "from cfx.models.krauss import Krauss, KraussSettings\n"
            "class S(KraussSettings):\n  name: str = 'x'\n"
            "class Bad(Krauss):\n  schema = S",
            "must not have a field 'name'",
        ),
    ],
)
def test_a_class_that_breaks_its_contract_is_refused(install, code: str, complaint: str) -> None:
    install("bad-models", {"cfx.models": {"bad": "bad_models:Bad"}}, {"bad_models.py": code})
    with pytest.raises(PluginError) as caught:
        registry.get("model", "bad")
    assert complaint in str(caught.value)
    assert "bad-models 1.0" in str(caught.value)
    assert not registry.is_loaded(registry.entry("model", "bad"))


def test_a_required_setting_that_a_node_leaves_null_is_asked_for(install) -> None:
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, {"mine_models.py": MODEL})
    with pytest.raises(
        ConfigError, match=r"model\.map: a value is required; give one as model\.map=\.\.\."
    ):
        registry.create("model", {"name": "mine", "map": None})


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (
            {"name": "krauss", "varaint": "sumo"},
            r"model\.varaint: unknown key\. Did you mean 'variant'\?",
        ),
        (
            {"name": "krauss", "variant": "car"},
            r"model\.variant='car': should be 'paper' or 'sumo'",
        ),
        (
            {"name": "krauss", "parameters": {"t_r": {"hgh": 3}}},
            r"model\.parameters\.t_r\.hgh: unknown key\.",
        ),
        (
            {"name": "krauss", "parameters": {"t_r": {"high": float("nan")}}},
            r"model\.parameters\.t_r\.high",
        ),
        ({}, r"model\.name: a value is required; choose a model: .*krauss, "),
        ("krauss", r"model='krauss': choose a model by its name"),
    ],
)
def test_a_wrong_node_is_explained_with_its_full_key(node: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        registry.create("model", node)


def test_bounds_that_exclude_the_default_are_explained() -> None:
    with pytest.raises(
        ParameterError, match=r"default 1\.5 lies outside its bounds \[0\.1, 0\.5\]"
    ):
        registry.create("model", {"name": "krauss", "parameters": {"t_r": {"high": 0.5}}})


def test_without_any_installed_component_the_message_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "entries", lambda kind: ())
    with pytest.raises(
        PluginError,
        match=r"no model is installed, not even cfx's own; run make run, or pip install -e",
    ):
        registry.get("model", "krauss")


def test_every_built_in_component_keeps_its_contract() -> None:
    for kind in registry.KINDS:
        for name in registry.names(kind):
            assert registry.get(kind, name).kind == kind


@pytest.mark.parametrize("kind", [kind for kind in registry.KINDS if kind != "table"])
def test_a_class_that_leaves_its_contract_open_cannot_be_made(kind: str) -> None:
    module, _, name = registry.KINDS[kind].base.partition(":")
    base = getattr(importlib.import_module(module), name)
    with pytest.raises(TypeError, match="abstract"):
        base()
