"""Third parties' plugins: tables, completion, and broken ones that harm nobody else."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cfx
from cfx.app import application, cli
from cfx.core import registry
from cfx.errors import PluginError, TrackingError
from cfx.results.tracker import folder_of
from tests.broken_plugins import BROKEN, MODEL, QUICK, Broken, install_twins, put
from tests.installer import Installer


def job(override: str, *, policy: str = "fixed") -> list[str]:
    """Returns a quick job that asks for one component more."""
    kept = [one for one in QUICK if not one.startswith((override.partition("=")[0], "policy"))]
    return [*kept, override, *([f"policy={policy}"] if not override.startswith("policy=") else [])]


@pytest.fixture
def twins(install: Installer) -> None:
    """Two third parties who chose the same name, and one who chose krauss."""
    install_twins(install)


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.name)
def test_who_asks_for_a_broken_plugin_gets_one_sentence_that_names_its_distribution(
    install: Installer, broken: Broken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    put(install, broken)
    with pytest.raises(PluginError, match=broken.complaint) as caught:
        cfx.run(job(broken.override, policy="gru" if broken.kind == "learners" else "fixed"))
    sentence = str(caught.value)
    assert f"{broken.distribution} 1.0" in sentence
    assert len(sentence.splitlines()) == 1


def test_all_broken_plugins_at_once_harm_nobody_else(
    install: Installer, twins: None, tmp_path: Path
) -> None:
    """Tables, help, completion and a job that asks for none work, in a process of their own."""
    for broken in BROKEN:
        put(install, broken)
    for name, metadata in (("nameless", "Version: 1.0\n"), ("garbled", "\x00\xff")):
        info = install.folder / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(metadata, encoding="latin-1")
        (info / "entry_points.txt").write_text(
            "[cfx.models]\nkrauss = nowhere:Krauss\n", encoding="utf-8"
        )
    script = """
        import os, sys
        from cfx.app.cli import main
        assert main(["plugins"]) == 0
        assert main(["--help"]) == 0
        os.environ["COMP_LINE"], os.environ["COMP_POINT"] = "cfx model=", "10"
        assert main(["-sc", "query=bash"]) == 0
        code = main(sys.argv[1:])
        imported = [name for name in sys.modules if name.startswith(("bad_", "twin_", "usurper"))]
        assert not imported, imported
        sys.exit(code)
    """
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "\n".join(line[8:] for line in script.splitlines()),
            *QUICK,
            "model=krauss",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(install.folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert re.search(
        r"^ *model +raises +bad-raises +1\.0 .* not loaded *$", done.stdout, re.MULTILINE
    )
    assert re.search(r"^ *model +newer +bad-newer +1\.0 .* broken *$", done.stdout, re.MULTILINE)
    assert len(re.findall(r"^ *model +twin .* shadowed *$", done.stdout, re.MULTILINE)) == 2
    assert re.search(r"^ *model +krauss +usurper .* shadowed *$", done.stdout, re.MULTILINE)
    assert "model=raises" in done.stdout.split()
    assert list(tmp_path.rglob("metrics.json"))


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("policies", "gru", "there is no kind of component 'policies'. Did you mean 'policy'?"),
        ("data", "tdy", "data=tdy: there is no dataset 'tdy'. Did you mean 'tidy'?"),
    ],
)
def test_to_show_what_is_not_there_is_one_sentence(
    kind: str, name: str, message: str, capsys
) -> None:
    assert cli.main(["plugins", "show", kind, name]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert message in said


def test_show_tells_everything_about_every_component(capsys) -> None:
    assert cli.main(["plugins", "show", "model", "w99"]) == 0
    printed = capsys.readouterr().out
    (row,) = [line for line in printed.splitlines() if line.strip().startswith("cc1 ")]
    assert "time gap kept above cc0" in row
    assert "Reference: Wiedemann" in printed
    assert "Choose it with model=w99." in printed
    assert "sumo: CC8 caps" in printed
    assert cli.main(["plugins", "show", "data", "tidy"]) == 0
    (row,) = [
        line for line in capsys.readouterr().out.splitlines() if line.strip().startswith("path ")
    ]
    assert "required" in row
    for kind in registry.KINDS:
        for name in registry.names(kind):
            assert cli.main(["plugins", "show", kind, name]) == 0
            printed = capsys.readouterr().out
            for setting in registry.get(kind, name).schema.model_fields:
                assert (kind, setting) == ("model", "parameters") or re.search(
                    rf"^ *{setting}[ .]", printed, re.MULTILINE
                )
    assert cli.main(["plugins", "show", "metric", "min_ttc"]) == 0
    printed = capsys.readouterr().out
    assert "Every job measures it" in printed
    assert "Hayward" in printed
    assert cli.main(["plugins", "show", "optimizer", "random"]) == 0
    printed = capsys.readouterr().out
    assert "Sobol'" in printed
    assert re.search(r"samples +4096 +int, >= 1 +evaluations of each problem", printed)


@pytest.mark.parametrize(
    ("kind", "name", "use"),
    [
        ("figure", "policy_errors", "figures/policy_errors.png"),
        ("head", "offset", "Choose it with learner.head=offset."),
        ("export", "driver_json", "Choose it with cfx export JOB --to driver_json."),
        ("posterior", "abc_rejection", "Choose it with calibration.posterior=abc_rejection."),
        ("tracker", "mlflow", "Choose it with tracking.name=mlflow."),
    ],
)
def test_show_says_how_one_asks_for_what_has_no_settings(
    kind: str, name: str, use: str, capsys
) -> None:
    assert cli.main(["plugins", "show", kind, name]) == 0
    printed = capsys.readouterr().out
    assert use in printed
    assert "It has no settings." in printed


def test_a_broken_tracker_keeps_nobody_from_a_run_of_another(
    install: Installer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    monkeypatch.chdir(tmp_path)
    install(
        "no-list", {"cfx.trackers": {"a_list": "no_list:Runs"}}, {"no_list.py": "import nobody"}
    )
    with pytest.raises(TrackingError, match="'nowhere' is no folder"):
        folder_of("nowhere")
    assert "Runs of tracking.name=a_list are not found: tracker 'a_list'" in caplog.text
    assert "no-list 1.0" in caplog.text


def test_plugins_lists_metadata_and_loads_nothing(install: Installer, capsys) -> None:
    install(
        "bad-models",
        {"cfx.models": {"bad": "bad_models:Bad"}},
        {"bad_models.py": "raise SystemExit(0)"},
        version="3.1",
    )
    assert cli.main(["plugins"]) == 0
    (bad,) = [line for line in capsys.readouterr().out.splitlines() if " bad " in line]
    assert bad.split() == [
        "model",
        "bad",
        "bad-models",
        "3.1",
        str(install.folder),
        "not",
        "loaded",
    ]
    assert "bad_models" not in sys.modules


COMPLETE = """
export PATH="$1:$PATH"; shift
eval "$(cfx -sc install=bash)"
for line in "$@"; do
    COMP_LINE="$line"; COMP_POINT=${#line}; COMP_WORDS=($line)
    COMP_CWORD=$(( ${#COMP_WORDS[@]} - 1 )); COMPREPLY=()
    hydra_bash_completion
    echo "${COMPREPLY[*]}"
done
"""


def test_the_shell_completes_a_plugins_name_and_its_parameters(install: Installer) -> None:
    """With the script that `cfx -sc install=bash` gives the shell, called as the shell calls it."""
    install("mine-models", {"cfx.models": {"mine": "mine_models:Mine"}}, {"mine_models.py": MODEL})
    put(install, BROKEN[0])
    done = subprocess.run(
        [
            "bash",
            "-c",
            COMPLETE,
            "bash",
            str(Path(sys.executable).parent),
            "cfx model=mi",
            "cfx model=mine model.parameters.tau.l",
        ],
        env={**os.environ, "PYTHONPATH": str(install.folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines() == ["model=mine", "model.parameters.tau.low="], done.stderr


DEPRECATED = """
    import warnings
    from pydantic import Field
    from cfx.plugin import DrivingModel, ModelSettings, Parameter, ParameterSpace

    class OldSettings(ModelSettings):
        mood: str = Field("calm", description="how it drives", deprecated="use model.style")

    class Old(DrivingModel):
        schema = OldSettings
        parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap", "made up"))
        {}

        def next_speed(self, follower, leader, p, dt):
            return follower.speed + 0.0 * p["tau"]
"""


def test_what_is_deprecated_still_works_and_is_named_with_its_distribution(
    install: Installer, caplog, capsys
) -> None:
    old = DEPRECATED.format('deprecated = "use model=new"')
    install("old-models", {"cfx.models": {"old": "old_models:Old"}}, {"old_models.py": old})
    install(
        "some-models",
        {"cfx.models": {"some": "some_models:Old"}},
        {"some_models.py": DEPRECATED.format("")},
    )
    registry.create("model", {"name": "some", "mood": "calm"})
    assert caplog.messages == []
    registry.create("model", {"name": "some", "mood": "angry"})
    registry.create("model", {"name": "old"})
    first, second = caplog.messages
    assert first.startswith(
        "model.mood of model 'some' (some_models:Old) of the distribution some-models 1.0"
        " is deprecated: use"
    )
    assert second.endswith("of the distribution old-models 1.0 is deprecated: use model=new")
    assert cli.main(["plugins", "show", "model", "old"]) == 0
    printed = capsys.readouterr().out
    assert "Deprecated: use model=new" in printed
    assert "how it drives (deprecated: use model.style)" in printed


def test_a_name_of_cfxs_own_always_means_cfxs_own(
    twins: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert registry.get("model", "krauss").__module__ == "cfx.models.krauss"
    result = application.run(QUICK)
    metrics = json.loads((result.folder / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["rmse_speed/driver_specific"] > 0
    with pytest.raises(
        PluginError,
        match=r"two distributions bring a model 'twin': twin-one 1\.0 .* and twin-two 2\.0",
    ):
        registry.get("model", "twin")


def test_a_preset_that_no_longer_fits_its_model_is_named(
    install: Installer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    preset = "defaults: [_mine, _self_]\nparameters: {gone: {default: 1.0}}\n"
    files = {"preset_plugin/__init__.py": MODEL, "preset_plugin/conf/model/brisk.yaml": preset}
    install("cfx-preset", {"cfx.models": {"mine": "preset_plugin:Mine"}}, files)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["model=brisk", "debug=quick", "tracking.enabled=false"]) == 2
    said = capsys.readouterr().err
    assert "model.parameters.gone: the model has no such parameter" in said
    assert "It is set in " in said
    assert "brisk.yaml" in said
