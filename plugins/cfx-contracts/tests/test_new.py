"""New packages: what is written installs, passes its tests, and says what it is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import cfx
from cfx.app import cli
from cfx.core import registry
from cfx.errors import ConfigError, OutputError, PluginError
from cfx_contracts.new import create
from tests.checkout import ROOT, module_of
from tests.installer import Installer

templates = module_of(ROOT / "plugins" / "cfx-contracts" / "templates.py")

NOVEL = sorted(set(registry.every_kind()) - {"section"})
"""Every kind that is known here and has a template; rivals are known where cfx-report is."""

GENERATED = [
    pytest.param(kind, marks=[] if kind == "model" else pytest.mark.slow) for kind in NOVEL
]


def test_templates_are_the_examples_components() -> None:
    """Each kind has a component in cfx-example, whose files `make conf` turns into templates."""
    assert {kind for kind, _, _ in templates.components()} == {*NOVEL, "rival"}
    written = {}
    for path in templates.TEMPLATES.rglob("*.jinja"):
        written[path.relative_to(templates.TEMPLATES)] = path.read_text(encoding="utf-8")
    from_example = templates.texts()
    common = {path for path in written if path.parts[0] == "common"}
    assert set(written) - common == set(from_example), "make conf"
    for path, text in from_example.items():
        assert written[path] == text, f"{path}: make conf"


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


def test_a_kind_of_another_distribution_has_no_template(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
) -> None:
    another = registry.Kind("poster", "cfx.core.component:Component", chosen=False)
    monkeypatch.setitem(registry.SIMPLE_KINDS, "poster", another)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["plugins", "new", "poster", "mine"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("there is no template of the kind 'poster'; there are templates of: ")
    assert "entry point of the group cfx.posters" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "modle"], "there is no kind of component 'modle'. Did you mean 'model'?"),
        (["check", "model", "w98"], "there is no model 'w98'. Did you mean 'w99'?"),
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
