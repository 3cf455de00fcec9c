"""The configuration: one frozen object; files in conf/ compose; nodes are what classes say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from pydantic import Field, ValidationError

from cfx.app import hydra_source, nodes
from cfx.core import registry
from cfx.core.files import path_override
from cfx.errors import ConfigError, PluginError
from cfx.plugin import DrivingModel, Parameter, ParameterSpace, Settings
from cfx.results.config import JobConfig

CONF = nodes.conf_dir()

PLUGIN = '''
    from pydantic import Field
    from cfx.plugin import DrivingModel, Parameter, ParameterSpace
    from cfx.models.base import ModelSettings

    class MineSettings(ModelSettings):
        mood: str = Field("calm", description="how it drives")

    class Mine(DrivingModel):
        """Drives as I like."""
        schema = MineSettings
        parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time headway"))

        def next_speed(self, follower, leader, p, dt):
            return follower.speed
'''


def values_of(*overrides: str) -> dict[str, Any]:
    """Composes as the command line does and returns plain data."""
    return hydra_source.plain(hydra_source.composed(overrides))


def test_config_yaml_says_the_same_as_the_class() -> None:
    values = values_of()
    config = JobConfig.of(values)
    kinds = set(registry.GROUPS)
    assert set(values) == set(JobConfig.model_fields)
    written = yaml.safe_load(config.model_dump_json(exclude=kinds))
    declared = yaml.safe_load(
        JobConfig(**{group: {} for group in kinds}).model_dump_json(exclude=kinds)
    )
    folder = Path(written["cache"].pop("folder"))
    assert folder == Path.cwd() / declared["cache"].pop("folder")
    assert written == declared


def test_a_job_config_cannot_be_changed() -> None:
    config = JobConfig.of(values_of())
    with pytest.raises(ValidationError):
        config.seed = 1  # type: ignore[misc]  # that is the point


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=-1", r"^seed=-1: should be greater than or equal to 0"),
        ("seed=1.5", r"^seed=1\.5: "),
        ("split=1.1", r"^split=1\.1: should be less than or equal to 1"),
        ("device=gpu", r"^device='gpu': choose auto, cpu, cuda or cuda:N"),
        ("dtype=float16", r"^dtype='float16': should be 'float32' or 'float64'"),
        ("threads=0", r"^threads=0: "),
        (
            "cache.folder=null",
            r"^cache\.folder=None: write a folder or a URL; cache\.enabled=false",
        ),
        ("windows.length=0", r"^windows\.length=0: "),
        (
            "style.cluster=agressive",
            r"^style\.cluster='agressive': should be 'all', 'conservative'",
        ),
        ("metrics=[1,2]", r"^metrics\.0=1: should be a valid string\.$"),
        ("metrics=[]", r"^metrics=\[\]: write own, all, or a list of names"),
        ("metrics=3", r"^metrics=3: write own, all, or a list of names"),
        (
            "metrics=[rmse_gap,rmse_gap]",
            r"^metrics=.*: 'rmse_gap' stands there twice; write each once",
        ),
        ("figure_formats=[png,png]", r"^figure_formats=.*: 'png' stands there twice"),
        ("style.percentiles=[75,25]", r"^style.*percentiles"),
        ("+style.clster=all", r"^style\.clster: unknown key\. Did you mean 'cluster'\?"),
        ("+sede=1", r"^sede: unknown key\. Did you mean 'seed'\?"),
        ("~model", r"^model: a value is required"),
    ],
)
def test_a_wrong_value_is_explained_with_its_full_key(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        JobConfig.of(values_of(override))


def test_several_wrong_values_are_all_named() -> None:
    with pytest.raises(ConfigError) as caught:
        JobConfig.of(values_of("seed=-1", "split=2"))
    assert [line.partition("=")[0] for line in str(caught.value).splitlines()] == ["seed", "split"]


def test_seed_zero_is_a_seed() -> None:
    assert JobConfig.of(values_of("seed=0")).seed == 0


def _option(path: Path) -> tuple[str, str]:
    """Returns the config group of a file in conf/ and the option that chooses it."""
    parts = path.relative_to(CONF).with_suffix("").parts
    depth = 2 if parts[0] == "hydra" else 1
    return "/".join(parts[:depth]), "/".join(parts[depth:])


OPTIONS = sorted(_option(path) for path in CONF.rglob("*.yaml") if path.parent != CONF)


@pytest.mark.parametrize(
    ("group", "name"), OPTIONS, ids=[f"{group}={name}" for group, name in OPTIONS]
)
def test_every_file_in_conf_composes_and_its_components_can_be_created(
    group: str, name: str
) -> None:
    values = values_of(f"{group}={name}")
    config = JobConfig.of(values)
    for key, kind in registry.GROUPS.items():
        if getattr(config, key) is None:
            continue  # a job needs no demonstration
        node = dict(getattr(config, key))
        for required in ("path", "run"):
            if required in node:
                node[required] = "somewhere"
        assert registry.create(kind.name, node).kind == kind.name


@pytest.mark.parametrize("entry", nodes.built_in(), ids=lambda entry: f"{entry.kind}-{entry.name}")
def test_the_file_of_a_built_in_component_is_what_its_class_says(entry: registry.Entry) -> None:
    assert nodes.file_path(entry).read_text(encoding="utf-8") == nodes.file_text(entry), (
        "run `make conf`"
    )


def test_conf_holds_no_file_of_a_component_that_is_gone() -> None:
    known = {nodes.file_path(entry) for entry in nodes.built_in()}
    written = {
        path
        for group in registry.GROUPS
        for path in (CONF / group).glob("*.yaml")
        if path.read_text(encoding="utf-8").startswith("# Written by `make conf`")
    }
    assert written <= known


def test_every_bound_of_a_models_parameters_is_overridden_without_a_plus() -> None:
    for model in registry.names("model"):
        space = registry.get("model", model).parameters  # type: ignore[attr-defined]  # a DrivingModel
        keys = {parameter.name: f"model.parameters.{parameter.name}" for parameter in space}
        highs = [f"{keys[parameter.name]}.high={parameter.high + 1}" for parameter in space]
        node = values_of(
            f"model={model}", *highs, *(f"{key}.tuned=false" for key in keys.values())
        )["model"]
        for parameter in space:
            assert node["parameters"][parameter.name]["high"] == parameter.high + 1
            assert node["parameters"][parameter.name]["tuned"] is False


class _Inner(Settings):
    depth: int = Field(3, description="how deep, m")


class _OddSettings(Settings):
    text: str = Field("1e5", description="looks like a number")
    word: str = "on"
    interpolation: str = "${seed} # no"
    lines: str = Field("a\nb", description="two\nlines " + "long " * 60)
    listed: tuple[float, ...] = (1.0, 2e-7)
    mapped: dict[str, int] = Field(default_factory=lambda: {"a b": 1})
    folder: Path = Path("some/where")
    inner: _Inner = Field(_Inner(), description="nested")
    nothing: float | None = None
    given: int = Field(description="needed")


class _Odd(DrivingModel):
    """Has every sort of setting."""

    schema = _OddSettings
    parameters = ParameterSpace.of(
        Parameter("yes", "1", -1e-9, 1e22, 0.0, "a name that YAML reads as true", "here")
    )


def test_a_node_reads_back_as_the_defaults_of_its_class() -> None:
    text = nodes.render(_Odd, "odd")
    node = OmegaConf.to_container(OmegaConf.create(text), resolve=True)
    assert node == {
        "name": "odd",
        "text": "1e5",
        "word": "on",
        "interpolation": "${seed} # no",
        "lines": "a\nb",
        "listed": [1.0, 2e-7],
        "mapped": {"a b": 1},
        "folder": "some/where",
        "inner": {"depth": 3},
        "nothing": None,
        "given": None,
        "parameters": {"yes": {"low": -1e-9, "high": 1e22, "default": 0.0, "tuned": True}},
    }
    assert "# yes, 1: a name that YAML reads as true (here)" in text
    assert "depth: 3  # how deep, m" in text
    assert max(len(line) for line in text.splitlines()) <= 130


LIMITS = {
    "acceleration": 2.6,
    "comfortable_deceleration": 4.5,
    "emergency_deceleration": 9.0,
    "response_time": None,
}


def test_a_third_partys_model_is_an_option_and_its_node_is_written_from_its_class(install) -> None:
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, {"mine_models.py": PLUGIN})
    node = values_of("model=mine", "model.parameters.tau.high=9", "model.mood=wild")["model"]
    tau = {"low": 0.5, "high": 9, "default": 1.0, "tuned": True}
    assert node == {
        "name": "mine",
        "adaptation_bounds": None,
        "limits": LIMITS,
        "mood": "wild",
        "parameters": {"tau": tau},
    }


def test_a_plugins_own_yaml_wins_and_may_extend_the_generated_node(install) -> None:
    files = {
        "mine_models/__init__.py": PLUGIN,
        "mine_models/conf/model/mine.yaml": "defaults: [_mine, _self_]\nmood: wild\n",
        "mine_models/conf/model/mine_far.yaml": "defaults: [mine, _self_]\n"
        "parameters: {tau: {high: 8.0}}\n",
    }
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, files)
    assert values_of("model=mine")["model"]["mood"] == "wild"
    far = values_of("model=mine_far", "model.parameters.tau.low=0.7")["model"]
    assert far == {
        "name": "mine",
        "adaptation_bounds": None,
        "limits": LIMITS,
        "mood": "wild",
        "parameters": {"tau": {"low": 0.7, "high": 8.0, "default": 1.0, "tuned": True}},
    }


def test_a_broken_plugin_harms_no_composition_that_does_not_choose_it(install) -> None:
    files = {
        "bad_models/__init__.py": "raise SystemExit(5)",
        "bad_models/conf/model/other.yaml": "name: krauss\n",
    }
    points = {
        "cfx.models": {"bad": "bad_models:Bad"},
        "cfx.policies": {"ghost": "not_there_at_all:Ghost"},
    }
    install("bad-models", points, files)
    assert values_of()["model"]["name"] == "idm"
    assert values_of("model=other")["model"] == {"name": "krauss"}
    with pytest.raises(PluginError, match=r"bad-models 1\.0 cannot be imported: SystemExit: 5"):
        values_of("model=bad")
    with pytest.raises(PluginError, match="not_there_at_all"):
        values_of("policy=ghost")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=true", "seed=True: give a number, not true or false"),
        ("optimizer.samples=false", "optimizer.samples=False: give a number"),
        ("learner.learning_rate=true", "learner.learning_rate=True: give a number"),
        ("cores=true", "cores=True: give a number"),
    ],
)
def test_truth_is_no_number(override: str, message: str) -> None:

    def made() -> None:
        config = JobConfig.of(values_of(override))
        registry.create("optimizer", config.optimizer)
        registry.create("learner", config.learner)

    with pytest.raises(ConfigError, match=message):
        made()


def test_a_password_in_the_tracking_uri_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from cfx.app import cli

    folder = tmp_path / "job"
    uri = "tracking.uri=postgresql://me:secret@host/db"
    assert cli.main([uri, f"hydra.run.dir={folder}"]) == 2
    err = capsys.readouterr().err
    assert "MLFLOW_TRACKING_URI" in err
    assert "secret" not in err
    assert not folder.exists()
    with pytest.raises(ConfigError, match="holds a password"):
        JobConfig.of(values_of(uri))


def test_more_threads_than_cores_are_not_used(caplog: pytest.LogCaptureFixture) -> None:
    import torch

    from cfx.core.threads import cores, set_threads

    before = torch.get_num_threads()
    try:
        set_threads(100_000)
        assert torch.get_num_threads() == cores()
        assert f"there are {cores()} cores here" in caplog.text
    finally:
        torch.set_num_threads(before)


@given(st.text("ab1='\\\", (){}[]:#~@+-%\u00fc./;", min_size=1, max_size=12))
def test_hydra_reads_any_path_back(name: str) -> None:
    """Names of rows hold equals signs, folders of people spaces and quotes."""
    path = Path("/place") / name
    override = OverridesParser.create().parse_override(path_override("data.path", path))
    assert override.value() == str(path)
