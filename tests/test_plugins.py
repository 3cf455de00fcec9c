"""Third parties' plugins: tables, checks, new packages, and broken ones that harm nobody else."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import cfx
from cfx.app import application, cli
from cfx.core import registry
from cfx.errors import ConfigError, OutputError, PluginError
from cfx_contracts.new import create
from tests.broken_plugins import BROKEN, QUICK, Broken
from tests.checkout import ROOT
from tests.installer import Installer

NOVEL = [kind for kind in registry.every_kind() if kind != "section"]
"""Every kind of cfx's own; cfx-report adds sections where it is imported."""

MODEL = """
    from cfx.plugin import DrivingModel, Parameter, ParameterSpace

    class Mine(DrivingModel):
        '''Drives as I like.'''

        parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap", "made up"))
        reference = "made up"

        def next_speed(self, follower, leader, p, dt):
            gap = leader.position - leader.length - follower.position
            return (gap / p["tau"]).clamp(min=0.0, max=30.0)
"""


def put(install: Installer, broken: Broken) -> None:
    install(broken.distribution, broken.entry_points, dict(broken.files))


def job(override: str, *, policy: str = "fixed") -> list[str]:
    """Returns a quick job that asks for one component more."""
    kept = [one for one in QUICK if not one.startswith((override.partition("=")[0], "policy"))]
    return [*kept, override, *([f"policy={policy}"] if not override.startswith("policy=") else [])]


@pytest.fixture
def twins(install: Installer) -> None:
    """Two third parties who chose the same name, and one who chose krauss."""
    install("twin-one", {"cfx.models": {"twin": "twin_one:Mine"}}, {"twin_one.py": MODEL})
    install(
        "twin-two", {"cfx.models": {"twin": "twin_two:Mine"}}, {"twin_two.py": MODEL}, version="2.0"
    )
    install(
        "usurper", {"cfx.models": {"krauss": "usurper:Mine"}}, {"usurper.py": "raise SystemExit(0)"}
    )


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


@pytest.mark.parametrize("kind", [kind for kind in NOVEL if kind in registry.PARTS])
def test_a_kind_without_a_contract_is_loaded_and_said_to_have_none(kind: str, capsys) -> None:
    name = registry.names(kind)[0]
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


def test_a_kind_of_another_distribution_has_no_template(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
) -> None:
    another = registry.Kind("poster", "cfx.core.component:Component", chosen=False)
    monkeypatch.setitem(registry.PARTS, "poster", another)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["plugins", "new", "poster", "mine"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("there is no template of the kind 'poster'; there are templates of: ")
    assert "entry point of the group cfx.posters" in said
    assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "modle"], "there is no kind of component 'modle'. Did you mean 'model'?"),
        (["check", "model", "w98"], "there is no model 'w98'. Did you mean 'w99'?"),
        (
            ["show", "policies", "gru"],
            "there is no kind of component 'policies'. Did you mean 'policy'?",
        ),
        (["show", "data", "tdy"], "data=tdy: there is no dataset 'tdy'. Did you mean 'tidy'?"),
        (["new", "modle", "mine"], "there is no kind of component 'modle'. Did you mean 'model'?"),
        (
            ["new", "figur", "mine"],
            "there is no kind of component 'figur'. Did you mean 'figure'?",
        ),
        (["check", "head", "ofset"], "there is no head 'ofset'. Did you mean 'offset'?"),
        (["new", "model", "krauss"], "the name 'krauss' is taken by model 'krauss'"),
        (
            ["new", "model", "My-Model"],
            "'My-Model' cannot be a component's name: it must be an identifier in lower-case"
            " letters, digits and _, such as my_model",
        ),
        (["new", "model", "lambda"], "'lambda' cannot be a component's name"),
        (["new", "model", "null"], "'null' cannot be a component's name"),
        (["new", "model", "_mine"], "'_mine' cannot be a component's name"),
        (
            ["new", "model", "mine", "--folder", "here"],
            "here exists already; choose another folder with --folder, or remove it",
        ),
        (["new", "model", "mine", "--folder", "file/below"], "file/below cannot be written"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)  # fmt: skip
def test_a_wrong_sub_command_is_one_sentence(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    (tmp_path / "file").write_text("a file")
    assert cli.main(["plugins", *arguments]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "here"]


def test_a_package_that_is_installed_already_is_not_written_again(
    install: Installer, tmp_path: Path
) -> None:
    install("cfx-mine", {}, {"cfx_mine/__init__.py": ""})
    with pytest.raises(PluginError, match="a package cfx_mine is installed already"):
        create("model", "mine", tmp_path / "mine")
    with pytest.raises(ConfigError, match="cannot be a component's name"):
        create("model", "Mine", tmp_path / "mine")
    (tmp_path / "other").mkdir()
    with pytest.raises(OutputError, match="exists already"):
        create("model", "other", tmp_path / "other")


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
        ("figure", "drives", "Every job that has what it shows draws it: figures/drives.png."),
        ("head", "offset", "Choose it with learner.head=offset."),
        ("export", "onnx", "Choose it with cfx export JOB --to onnx."),
        ("posterior", "laplace", "Choose it with calibration.posterior=laplace."),
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


GENERATED = [
    pytest.param(kind, marks=[] if kind == "model" else pytest.mark.slow) for kind in NOVEL
]


@pytest.mark.parametrize("kind", GENERATED)
def test_a_new_package_installs_and_its_tests_pass(kind: str, tmp_path: Path, capsys) -> None:
    folder = create(kind, f"novel_{kind}", tmp_path / "package")
    advice = capsys.readouterr().out
    assert f"python -m cfx plugins check {kind} novel_{kind}" in advice
    assert f"pip install --editable '{folder}[test]'" in advice, "with pytest"
    environment = installed(folder, tmp_path / "site")
    tests = run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-W",
            "error",
            "-p",
            "no:cacheprovider",
            str(folder),
        ],
        environment,
    )
    assert " passed" in tests
    assert "failed" not in tests
    group = registry.kind_of(kind).group
    presets = [path.stem for path in folder.glob(f"cfx_novel_{kind}/conf/{group}/*.yaml")]
    asked = f"plugins show {kind} novel_{kind}"
    expected = f"cfx_novel_{kind}.{kind}:Novel{kind.capitalize()}"
    if kind == "command":
        asked = "--help"
        expected = (
            "cfx novel_command how much each of some jobs improves on constant parameters"
            " (from cfx-novel-command)"
        )
    if presets:
        (preset,) = presets
        asked = f"--cfg job {group}={preset}"
        expected = f"name: novel_{kind}"
    script = (
        "import sys; from cfx.app.cli import main;"
        " sys.exit(max(main(words.split()) for words in sys.argv[1:]))"
    )
    words = [f"plugins check {kind} novel_{kind}", asked]
    said = run([sys.executable, "-c", script, *words], environment)
    assert re.search(
        rf"{kind} +novel_{kind} +cfx-novel-{kind} +0\.1\.0 .* fine *$", said, re.MULTILINE
    )
    assert "declares no version" not in said
    assert expected in said


def installed(folder: Path, site: Path) -> dict[str, str]:
    """Installs a package as a user would, but offline; returns an environment that has it."""
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    run([*pip, "--disable-pip-version-check", "--target", str(site), str(folder)], dict(os.environ))
    return {**os.environ, "PYTHONPATH": str(site)}


def run(command: list[str], environment: dict[str, str]) -> str:
    done = subprocess.run(
        command,
        env=environment,
        cwd=environment.get("HOME"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def novel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a new package of each kind."""
    home = tmp_path_factory.mktemp("novel") / "deep"
    for kind in NOVEL:
        create(kind, "novel", home / kind)
    return home


@pytest.mark.parametrize("kind", NOVEL)
def test_a_new_package_declares_what_it_is(kind: str, novel: Path) -> None:
    folder = novel / kind
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == "cfx-novel"
    assert any(one.startswith("cfx-driving>=") and "<" in one for one in project["dependencies"])
    assert project["entry-points"][registry.kind_of(kind).entry_points] == {
        "novel": f"cfx_novel.{kind}:Novel"
    }
    assert project["entry-points"]["cfx.api"] == {str(cfx.plugin.API_VERSION): "cfx_novel"}
    written = [path for path in folder.rglob("*") if path.is_file()]
    assert {"README.md", ".gitignore", "pyproject.toml", "test_novel.py"} <= {
        path.name for path in written
    }
    for path in written:
        assert not re.search(r"\{\{|\{%|\.jinja", path.name + path.read_text(encoding="utf-8")), (
            path
        )
    assert "Licence" in (folder / "README.md").read_text(encoding="utf-8")
    assert {path.name for path in novel.iterdir()} == set(NOVEL)


def test_a_new_package_is_clean(novel: Path) -> None:
    """Its Python passes ruff with the rules that cfx itself keeps, docstrings of tests apart."""
    rules = "B,C4,E,F,I,N,PERF,PIE,RET,SIM,UP,W"
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--no-cache", "--select", rules]
    command += ["--line-length", "100", "--config", "src=['*']"]
    command += ["--config", "lint.isort.known-third-party=['cfx','cfx_contracts']"]
    done = subprocess.run(command, cwd=novel, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_templates_are_in_the_wheel(tmp_path: Path) -> None:
    import zipfile

    script = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
    subprocess.run(
        [sys.executable, "-c", script, tmp_path],
        cwd=ROOT / "plugins" / "cfx-contracts",
        capture_output=True,
        check=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    package = ROOT / "plugins" / "cfx-contracts"
    expected = {
        path.relative_to(package).as_posix()
        for path in (package / "cfx_contracts" / "template").rglob("*")
        if path.is_file()
    }
    assert len(expected) > 20
    assert expected <= names


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
    assert metrics["rmse_speed/fixed"] > 0
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
