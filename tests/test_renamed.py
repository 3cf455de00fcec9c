"""What users wrote down for the version before still works, and a warning says the new name."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

import cfx
from cfx import application, cli, hydra_source, registry, renamed
from cfx.config import JobConfig
from cfx.contracts.optimizers import Problems, bowl
from cfx.errors import ConfigError
from cfx.job.output import Output, write_metrics
from cfx.models.krauss import Krauss
from cfx.policies.gru import GruPolicy

Warnings = Callable[[], list[str]]


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture) -> Warnings:
    """Returns a function that gives the messages since it was last asked."""
    caplog.set_level(logging.WARNING, logger="cfx")

    def since() -> list[str]:
        messages = [record.getMessage() for record in caplog.records]
        caplog.clear()
        return messages

    return since


# ---- the command line


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("learner.members=3", "learner.ensemble_size=3"),
        ("learner.members=3,5", "learner.ensemble_size=3,5"),
        ("+learner.members=3", "+learner.ensemble_size=3"),
        ("++policy.traits=[time_gap]", "++policy.driver_features=[time_gap]"),
        ("~learner.taught", "~learner.distillation_epochs"),
        ("model.reach.t_r=[0.1,20]", "model.adaptation_bounds.t_r=[0.1,20]"),
        ("simulation.compile=never", "simulator.compile=never"),
        ("experiment=strangers", "experiment=unseen_drivers"),
        ("+experiment=strangers", "+experiment=unseen_drivers"),
        ("experiment=strangers,adaptive", "experiment=unseen_drivers,adaptive"),
        ("experiment=choice(adaptive,strangers)", "experiment=choice(adaptive,unseen_drivers)"),
        ("learner@other=rollout_taught", "learner@other=rollout_distilled"),
    ],
)
def test_an_override_of_the_version_before_says_its_new_name(
    old: str, new: str, warnings: Warnings
) -> None:
    assert renamed.overrides([old]) == [new]
    (message,) = warnings()
    assert "is now called" in message


@pytest.mark.parametrize(
    "argument",
    [
        "-m",
        "--cfg",
        "job",
        "seed=0,1",
        "hydra/launcher=joblib",
        "hydra.sweep.dir='learner.members=3'",
        "data.path=strangers.csv",
        "~experiment",
        "learner=rollout",
        "learner.membership=3",
        "model.parameters.reach.high=3",
        "policy.inputs=[leader_speed,follower_speed]",
        "",
        "not an override",
    ],
)
def test_other_arguments_stay_as_they_are(argument: str, warnings: Warnings) -> None:
    assert renamed.overrides([argument]) == [argument]
    assert not warnings()


@pytest.mark.parametrize(("group", "name"), renamed.OPTIONS)
def test_every_option_leads_to_one_that_composes(group: str, name: str) -> None:
    arguments = renamed.overrides([f"{group}={name}"])
    assert hydra_source.composed(arguments)


@pytest.mark.parametrize("path", renamed.SETTINGS.values())
def test_every_new_path_is_a_key_of_some_configuration(path: str) -> None:
    nodes = [[], ["learner=rollout"], ["learner=imitation"], ["policy=lstm"]]
    missing = object()
    found = [OmegaConf.select(hydra_source.composed(node), path, default=missing) for node in nodes]
    assert any(value is not missing for value in found)


def test_the_command_line_takes_names_of_the_version_before(
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["experiment=strangers", "learner.members=2", "--cfg", "job"]
    assert cli.main(command) == 0
    printed = capsys.readouterr().out
    assert "cold_start_fraction: 1.0" in printed
    assert "ensemble_size: 2" in printed
    assert "members" not in printed


MINE = """
    from cfx import Learner, Settings

    class MineSettings(Settings):
        members: int = 2

    class Mine(Learner):
        schema = MineSettings

        def fit(self, policy, training_data):
            return None
"""


def test_a_third_partys_setting_of_an_old_name_is_left_alone(install, warnings: Warnings) -> None:
    install("mine", {"cfx.learners": {"mine": "mine_learner:Mine"}}, {"mine_learner.py": MINE})
    arguments = ["learner=mine", "learner.members=3"]
    assert application.todays(arguments) == arguments
    assert registry.current_node("learner", {"name": "mine", "members": 3})["members"] == 3
    assert not warnings()


def test_a_setting_that_is_gone_is_left_out_with_its_sentence(
    monkeypatch: pytest.MonkeyPatch, warnings: Warnings
) -> None:
    monkeypatch.setitem(renamed.REMOVED, "learner.huber", "write learner.objective=huber")
    assert renamed.overrides(["seed=1", "learner.huber=2"]) == ["seed=1"]
    assert warnings() == ["learner.huber is gone and was left out: write learner.objective=huber"]
    node = renamed.node("learner", {"name": "rollout", "huber": 2, "epochs": 3})
    assert node == {"name": "rollout", "epochs": 3}
    assert warnings() == ["learner.huber is gone and was left out: write learner.objective=huber"]


def test_settings_of_rollout_that_are_gone_say_what_to_write(warnings: Warnings) -> None:
    given = {"name": "rollout", "error": "huber", "huber_delta": 0.4, "normalise": True}
    assert renamed.node("learner", given | {"gradient_clip": None}) == {
        "name": "rollout",
        "gradient_clip": None,
    }
    said = " ".join(warnings())
    assert "objective=speed_huber objective.delta=..." in said
    assert "learner.normalise is gone" in said
    assert renamed.overrides(["learner.error=rmse", "learner.epochs=2"]) == ["learner.epochs=2"]


# ---- configuration files


def values(**changes: Any) -> dict[str, Any]:
    plain = hydra_source.plain(hydra_source.composed(["learner=rollout"]))
    return {**plain, **changes}


def test_a_node_of_the_version_before_becomes_todays(warnings: Warnings) -> None:
    given = {"name": "rollout_taught", "members": 3, "ensemble_size": 5, "epochs": 7}
    node = renamed.node("learner", given)
    assert node == {"name": "rollout_distilled", "ensemble_size": 3, "epochs": 7}
    assert given["members"] == 3  # what was given is not changed
    assert len(warnings()) == 2
    assert renamed.node("learner", given, warn=False) == node
    assert not warnings()


def test_a_setting_may_move_deeper_into_its_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(renamed.SETTINGS, "learner.draws", "learner.sampling.draws")
    inner = {"seed": 1}
    node = renamed.node("learner", {"name": "rollout", "draws": 2, "sampling": inner})
    assert node == {"name": "rollout", "sampling": {"seed": 1, "draws": 2}}
    assert inner == {"seed": 1}
    assert renamed.overrides(["learner.draws=3"]) == ["learner.sampling.draws=3"]


def test_a_job_config_of_the_version_before_is_written_under_todays_names(
    warnings: Warnings,
) -> None:
    before = values()
    before["learner"]["members"] = before["learner"].pop("ensemble_size")
    before["simulation"] = {"memory_mb": 64}
    config = JobConfig.of(before)
    assert "members" not in config.learner
    assert config.learner["ensemble_size"] == values()["learner"]["ensemble_size"]
    assert config.simulator["memory_mb"] == 64
    assert len(warnings()) == 2


def test_a_setting_that_only_one_option_has_is_left_out_for_another() -> None:
    before = {"simulator": {"name": "sumo"}, "simulation": {"compile": "auto"}}
    assert renamed.config(before) == {"simulator": {"name": "sumo"}}


def test_an_unknown_key_of_a_group_that_moved_is_still_refused() -> None:
    with pytest.raises(ConfigError, match="simulation: unknown key"):
        JobConfig.of(values(simulation={"memory_mb": 64, "nonsense": 1}))


def compose_mine(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Returns the configuration that a user's own experiment file makes."""
    (folder / "experiment").mkdir()
    (folder / "experiment" / "mine.yaml").write_text(text, encoding="utf-8")
    search_path = f"hydra.searchpath=[file://{folder}]"
    config = hydra_source.composed([search_path, "experiment=mine"])
    return hydra_source.plain(config)


def test_a_users_file_may_name_settings_and_options_of_the_version_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, warnings: Warnings
) -> None:
    text = """# @package _global_
defaults:
  - strangers
  - override /model: w99_reaching
learner:
  members: 3
"""
    config = JobConfig.of(compose_mine(text, tmp_path, monkeypatch))
    assert config.learner["cold_start_fraction"] == 1.0
    assert config.learner["ensemble_size"] == 3
    assert (
        config.model
        == JobConfig.of(hydra_source.plain(hydra_source.composed(["model=w99_wide"]))).model
    )
    messages = "\n".join(warnings())
    assert "experiment=strangers is now called experiment=unseen_drivers" in messages
    assert "model=w99_reaching is now called model=w99_wide" in messages
    assert "learner.members is now called learner.ensemble_size" in messages


# ---- results


def test_metrics_answer_to_the_names_of_the_version_before() -> None:
    metrics = renamed.Metrics(
        {
            "rmse_improvement/shrunk/mean": 0.2,
            "steady/rmse_improvement/mean": 0.3,
            "full_trajectory/rmse_speed/policy": 0.4,
        }
    )
    old = {
        "rmse_improvement/base/mean": 0.2,
        "later/rmse_improvement/mean": 0.3,
        "whole/rmse_speed/policy": 0.4,
    }
    for name, value in old.items():
        assert name in metrics
        with pytest.deprecated_call(match=f"the metric {name} is now called"):
            assert metrics[name] == value
        with pytest.deprecated_call():
            assert metrics.get(name) == value
    assert metrics.get("steady/rmse_improvement/mean") == 0.3
    assert metrics.get("later/nothing") is None
    assert "later/nothing" not in metrics
    with pytest.raises(KeyError, match="later/nothing"):
        _ = metrics["later/nothing"]


def test_metrics_that_are_written_have_todays_names_alone(tmp_path: Path) -> None:
    metrics = renamed.metrics({"later/rmse_improvement/mean": 0.3, "whole/x": float("nan")})
    write_metrics(Output(tmp_path), metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == {
        "steady/rmse_improvement/mean": 0.3,
        "full_trajectory/x": None,
    }


def test_tables_get_todays_columns_and_methods() -> None:
    table = pd.DataFrame(
        {
            "method": ["policy", "base"],
            "later_rmse_speed": [1.0, 2.0],
            "rms_jerk": [1.0, 2.0],
            "real_rms_jerk": [1.0, 2.0],
            "whole_rmse_gap": [1.0, 2.0],
            "improvement_over_base": [0.1, 0.0],
        }
    )
    today = renamed.results(table)
    assert list(today) == [
        "method",
        "steady_rmse_speed",
        "jerk",
        "real_jerk",
        "full_trajectory_rmse_gap",
        "improvement_over_shrunk",
    ]
    assert list(today["method"]) == ["policy", "shrunk"]
    assert list(table["method"]) == ["policy", "base"]


def test_labels_have_columns_without_a_unit() -> None:
    table = pd.DataFrame({"window": [0], "loss_mps": [0.1], "spread_mps": [0.2]})
    assert list(renamed.results(table)) == ["window", "loss", "sensitivity"]


def test_an_optimizer_that_is_annotated_with_the_earlier_objective_works() -> None:
    """`cfx.Objective` was the protocol that is now `cfx.CandidateLosses`."""
    code = """
from cfx import Objective, Optimizer

class Mine(Optimizer):
    def evaluations(self):
        return 1

    def bytes_per_problem(self, n):
        return 0

    def solve(self, objective: Objective, guesses, *, seed):
        candidates = guesses[:, :1]
        return candidates, objective(candidates)
"""
    space: dict[str, Any] = {}
    exec(code, space)  # noqa: S102 - the module of a plugin
    guesses = torch.rand((3, 1, 2), dtype=torch.float64)
    found = space["Mine"]().minimize(Problems(bowl, guesses[:, 0]), guesses, seed=0)
    torch.testing.assert_close(found.best, guesses[:, 0])


def test_a_file_is_found_under_its_earlier_name_if_only_that_is_there(tmp_path: Path) -> None:
    today = tmp_path / "trajectories.parquet"
    assert renamed.file(today) == today
    (tmp_path / "drives.parquet").touch()
    assert renamed.file(today) == tmp_path / "drives.parquet"
    today.touch()
    assert renamed.file(today) == today


def test_data_json_says_whether_constant_parameters_are_a_baseline() -> None:
    assert renamed.data({"follows": False, "pairs": 3}) == {
        "has_constant_baseline": False,
        "pairs": 3,
    }


# ---- Python


@pytest.mark.parametrize(("old", "new"), renamed.PUBLIC.items())
def test_a_public_name_of_the_version_before_is_todays_class(old: str, new: str) -> None:
    vars(cfx).pop(old, None)
    with pytest.deprecated_call(match=f"cfx.{old} is now called cfx.{new}"):
        assert getattr(cfx, old) is getattr(cfx, new)
    assert old not in cfx.__all__


def test_a_plugins_class_may_say_follows() -> None:
    with pytest.deprecated_call(match="Mine.follows is now called has_constant_baseline"):

        class Mine(Krauss):
            follows = False

    assert not Mine.has_constant_baseline
    assert Krauss.has_constant_baseline


@pytest.mark.parametrize("name", ["softness", "reach", "smoothed"])
def test_a_model_answers_to_the_earlier_names_of_its_attributes(name: str) -> None:
    model = Krauss()
    with pytest.deprecated_call(match=f"Krauss.{name} is now called"):
        assert getattr(model, name) == getattr(model, renamed.ATTRIBUTES[name])
    with pytest.raises(AttributeError, match="'Krauss' has no attribute 'nonsense'"):
        _ = model.nonsense


def test_a_policy_answers_to_traits_and_a_model_does_not() -> None:
    policy = GruPolicy()
    with pytest.deprecated_call(match="GruPolicy.traits is now called driver_features"):
        assert policy.traits == policy.driver_features  # type: ignore[attr-defined]
    assert not hasattr(Krauss(), "traits")
