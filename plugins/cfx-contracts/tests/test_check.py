"""`cfx plugins check` tries components, and says in a sentence what is wrong with one."""

from __future__ import annotations

import importlib.util
import re

import pytest

from cfx.app import cli
from cfx.core import registry
from tests.broken_plugins import BROKEN, MODEL, install_twins, put
from tests.installer import Installer


@pytest.fixture
def twins(install: Installer) -> None:
    """Two third parties who chose the same name, and one who chose krauss."""
    install_twins(install)


@pytest.mark.parametrize(
    "kind",
    [
        "model",
        "simulator",
        "policy",
        "optimizer",
        "objective",
        "dataset",
        "engine",
        "learner",
        "protocol",
    ],
)
def test_check_finds_every_broken_plugin_and_says_one_sentence_each(
    install: Installer, twins: None, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = {}
    for broken in BROKEN:
        put(install, broken)
        if registry.KINDS[kind].entry_points == f"cfx.{broken.kind}":
            expected[broken.distribution] = broken.name
    own = {"optimizer": "random", "model": "krauss", "simulator": "memory"}.get(kind)
    for name in [*expected.values(), *([own] if own else [])]:
        cli.main(["plugins", "check", kind, name])
    printed = capsys.readouterr()
    complaints = printed.err.splitlines()
    for distribution, name in expected.items():
        assert sum(f"{distribution} 1.0" in line for line in complaints) == 1, (
            distribution,
            printed.err,
        )
        assert re.search(rf"^ *{kind} +{name} .* broken *$", printed.out, re.MULTILINE)
    if kind == "model":
        assert re.search(r"^ *model +krauss +cfx-driving .* fine *$", printed.out, re.MULTILINE)
        assert (
            "usurper 1.0 is never used, because cfx has a model 'krauss' of its own" in printed.err
        )


def test_check_exits_with_1_only_if_something_is_broken(
    install: Installer, twins: None, capsys
) -> None:
    assert cli.main(["plugins", "check", "model", "w99"]) == 0
    assert cli.main(["plugins", "check", "policy"]) == 0
    assert cli.main(["plugins", "check", "objective"]) == 0
    assert capsys.readouterr().err == ""
    assert cli.main(["plugins", "check", "model", "twin"]) == 1
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 2
    assert (
        "twin-one 1.0 cannot be used, because twin-two 2.0 brings a model of that name too"
        in complaints[0]
    )


def test_check_says_how_far_it_is(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr("cfx.core.progress._LINE_EVERY", 0.0)
    assert cli.main(["plugins", "check", "optimizer", "random"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if " after " in line]
    assert len(said) == 1, "what it does inside is not told"
    assert said[0].startswith("Checking components: 100 % after")


def test_check_names_the_extra_that_is_not_installed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What lacks an extra is not broken."""
    pytest.importorskip("cfx_dask", reason="its engine needs a package that may be missing")
    found = importlib.util.find_spec
    without = {"distributed": None}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: without.get(name, found(name, *more))
    )
    assert cli.main(["plugins", "check", "engine", "dask"]) == 0
    printed = capsys.readouterr()
    assert re.search(r"^ *engine +dask .* not installed *$", printed.out, re.MULTILINE)
    assert "Hint: engine=dask needs the package distributed: " in printed.out
    assert "cfx-dask" in printed.out
    assert printed.err == ""


def test_check_runs_the_contract_and_hints_at_what_could_be_better(
    install: Installer, capsys
) -> None:
    careless = MODEL.replace('"made up"))', '"", ))').replace(
        'reference = "made up"', "differentiable = False"
    )
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, {"mine_models.py": MODEL})
    install(
        "careless-models",
        {"cfx.models": {"careless": "careless_models:Mine"}},
        {"careless_models.py": careless},
    )
    assert cli.main(["plugins", "check", "model", "careless"]) == 1
    assert (
        "careless-models 1.0 breaks its contract: parameter tau has no source"
        in capsys.readouterr().err
    )
    registry.create(
        "model", {"name": "careless"}
    )  # a job may use it all the same: its numbers are sound
    assert cli.main(["plugins", "check", "data", "tidy"]) == 0
    assert (
        "Hint: dataset 'tidy' was loaded but not tried: it needs data.path."
        in capsys.readouterr().out
    )


@pytest.mark.parametrize("kind", ["figure", "head", "export", "posterior", "tracker"])
def test_a_kind_without_a_contract_is_loaded_and_said_to_have_none(kind: str, capsys) -> None:
    names = registry.names(kind)
    if not names:
        pytest.skip(f"no {kind} is installed")
    name = names[0]
    assert cli.main(["plugins", "check", kind, name]) == 0
    printed = capsys.readouterr()
    assert re.search(rf"^ *{kind} +{name} .* fine *$", printed.out, re.MULTILINE)
    (hint,) = re.findall(r"^Hint: .*$", printed.out, re.MULTILINE)
    assert hint.startswith(f"Hint: the kind '{kind}' has no contract")
    assert printed.err == ""


def test_a_broken_class_of_a_kind_without_a_contract_is_one_sentence(
    install: Installer, capsys
) -> None:
    code = "from cfx.plugin import ParameterHead\nclass Half(ParameterHead):\n    name = 'half'\n"
    install("half-heads", {"cfx.heads": {"half": "half_heads:Half"}}, {"half_heads.py": code})
    assert cli.main(["plugins", "check", "head", "half"]) == 1
    (complaint,) = capsys.readouterr().err.splitlines()
    assert "half-heads 1.0 does not implement for_model, unit_parameters, " in complaint


def test_a_distribution_that_declares_no_api_counts_as_current_and_gets_a_hint(
    install: Installer, capsys
) -> None:
    install(
        "mine-data",
        {"cfx.protocols": {"mine": "mine_protocol:Mine"}},
        {"mine_protocol.py": PROTOCOL},
    )
    assert cli.main(["plugins", "check", "protocol", "mine"]) == 0
    assert (
        "mine-data declares no version of cfx's plugin API and counts as built for the current one"
        in capsys.readouterr().out
    )


PROTOCOL = """
    import cfx

    class Mine(cfx.plugin.Protocol):
        def run(self, context):
            return cfx.get("protocol", "within_driver")().run(context)
"""
