"""Options that are not installed say the line that installs them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hydra.errors import MissingConfigException

from cfx.app.nodes import distributions_text
from cfx.app.user_errors import explain, no_command
from cfx.core import distributions, registry
from cfx.errors import PluginError
from tests.checkout import ROOT


def test_the_file_holds_what_the_plugins_here_bring() -> None:
    assert distributions.FILE.read_text("utf-8") == distributions_text(ROOT), "make conf"
    brought = distributions.brought()
    assert brought["model", "gipps"] == "cfx-community"
    assert brought["experiment", "forecast"] == "cfx-forecasts"
    assert brought["hydra/launcher", "dask"] == "cfx-dask"
    assert brought["calibration.posterior", "sbi"] == "cfx-posteriors[sbi]"


def test_the_extras_are_those_of_pyproject() -> None:
    for where in distributions.brought().values():
        distribution, bracket, extra = where.partition("[")
        if bracket:
            folder = ROOT if distribution == distributions.OWN else ROOT / "plugins" / distribution
            text = (folder / "pyproject.toml").read_text("utf-8")
            assert extra.rstrip("]") in tomllib.loads(text)["project"]["optional-dependencies"]


def test_an_option_that_is_not_installed_says_what_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    error = MissingConfigException("", missing_cfg_file="model/gipps", options=["idm", "krauss"])
    said = explain(error, ["model=gipps"])
    assert "It comes with cfx-community: " in said
    assert said.split(" install ")[1].startswith("--editable plugins/cfx-community")
    error = MissingConfigException("", missing_cfg_file="hydra/launcher/joblib", options=["basic"])
    assert "--editable '.[joblib]'" in explain(error, [])
    error = MissingConfigException("", missing_cfg_file="model/gips", options=["idm"])
    assert "Did you mean 'gipps'?" in explain(error, [])


def test_a_sub_command_that_is_not_installed_says_what_installs_it() -> None:
    said = no_command("plugins.new")
    assert said.startswith("cfx plugins new is not installed. It comes with cfx-contracts: ")
    assert "cfx --help" not in said


def test_a_kind_that_only_plugins_bring_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "entries", lambda kind: ())
    said = r"calibration.posterior=laplace: there is no .* It comes with cfx-posteriors: .* install"
    with pytest.raises(PluginError, match=said):
        registry.entry("posterior", "laplace")


def test_the_registry_says_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [one for one in registry.entries("optimizer") if one.name != "cma"]
    monkeypatch.setattr(registry, "entries", lambda kind: entries)
    with pytest.raises(
        PluginError, match=r"optimizer=cma: .* It comes with cfx-community: .* install"
    ):
        registry.entry("optimizer", "cma")


def test_outside_a_checkout_the_line_names_the_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distributions, "__file__", str(tmp_path / "cfx" / "core" / "here.py"))
    assert distributions.install_line("cfx-community").endswith(" install cfx-community")
    assert distributions.install_line("cfx-driving[sumo]").endswith(' install "cfx-driving[sumo]"')
