"""Each experiment is one command that says its question, how to start it and how long it takes."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

import cfx
from cfx.app import cli, hydra_source, nodes
from tests.checkout import DISTRIBUTIONS, ROOT, is_installed

FOLDER = nodes.conf_dir() / "experiment"
FOLDERS = [FOLDER]
for distribution in DISTRIBUTIONS:
    if is_installed(distribution):
        FOLDERS += (ROOT / "plugins" / distribution).glob("cfx_*/conf/experiment")
FILES = {
    str(path.relative_to(folder).with_suffix("")): path
    for folder in FOLDERS
    for path in folder.rglob("*.yaml")
}
NAMES = sorted(FILES)
SMALL = ["optimizer=random", "optimizer.samples=32", "figures=none", "learner.epochs=2"]
SMALL.append("calibration.prior=weak")


@functools.cache
def composed(*overrides: str) -> dict[str, Any]:
    """Returns a job's configuration; several tests look at the same one."""
    return hydra_source.plain(hydra_source.composed(overrides))


@pytest.mark.parametrize("name", NAMES)
def test_every_experiment_says_its_question_command_and_duration(name: str) -> None:
    text = FILES[name].read_text(encoding="utf-8")
    assert text.startswith("# @package _global_\n# Question: ")
    assert f"\n# Command:  python -m cfx experiment={name} " in text
    assert "\n# Duration: " in text
    assert composed(f"experiment={name}")["preset"] == name


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("paper/")])
def test_baselines_are_calibrated_as_a_calibration_is(name: str) -> None:
    chosen = composed(f"experiment={name}")["optimizer"]
    assert chosen == composed()["optimizer"]


@pytest.mark.parametrize("name", ["paper/pair", "paper/pairs", "paper/clusters", "paper/grid"])
def test_the_papers_experiments_train_as_the_paper_does(name: str) -> None:
    values = composed(f"experiment={name}", "data=tidy", "data.path=pairs.csv")
    own = composed("experiment=paper/imitation")
    assert (values["learner"], values["policy"], values["windows"]) == (
        own["learner"],
        own["policy"],
        own["windows"],
    )
    assert values["data"]["name"] == "tidy", "the command line's data wins over the experiment's"
    assert values["data"]["min_duration"] == 70, "the paper keeps pairs of 700 frames of 0.1 s"
    assert composed(f"experiment={name}")["data"]["min_duration"] == 0, "simulated ones are kept"


@pytest.mark.slow
def test_an_experiment_sweeps_without_being_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clusters of a small synthetic data set, two folds each: six jobs from one command."""
    monkeypatch.chdir(tmp_path)
    small = [
        "data.pairs=8",
        "data.frames=60",
        "protocol.folds=2",
        "tracking.enabled=false",
        "hydra.sweep.dir=out",
    ]
    assert cli.main(["experiment=paper/clusters", *SMALL, *small]) == 0
    assert "6 of 6 jobs done" in capsys.readouterr().out
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert sorted(zip(summary["model"], summary["style.cluster"], strict=True)) == [
        (model, cluster)
        for model in ("krauss", "w99")
        for cluster in ("aggressive", "conservative", "normal")
    ]
    for folder in summary["folder"]:
        job = tmp_path / "out" / folder
        assert yaml.safe_load((job / "config.yaml").read_text())["preset"] == "paper/clusters"
        assert "improvement/rmse_speed/pooled/geometric" in json.loads(
            (job / "metrics.json").read_text()
        )


def test_one_pair_has_its_table_and_its_speed_plots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    few = ["data.frames=120", "tracking.enabled=false", "figures=[speeds]"]
    result = cfx.run(["experiment=paper/pair", *SMALL, *few])
    assert result.pairs.method.tolist() == ["default", "driver_specific", "policy"]
    assert "speeds.png" in {path.name for path in result.figures}
