"""The distribution: what pyproject says is installed, and the wheel holds the config files."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import cfx
from cfx.app import nodes
from cfx.core import registry
from cfx.core.distributions import OWN

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def pins() -> dict[str, str]:
    """Returns the version of each distribution in constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    found = {}
    for line in lines:
        if line and not line.startswith("#"):
            name, _, version = line.partition("==")
            found[canonicalize_name(name)] = version
    return found


def test_entry_points_of_pyproject_are_the_installed_ones() -> None:
    declared = {
        group: set(points.items()) for group, points in PYPROJECT["project"]["entry-points"].items()
    }
    for kind in (*registry.KINDS.values(), *registry.SIMPLE_KINDS.values()):
        installed = {
            (one.name, one.target) for one in registry.entries(kind.name) if one.distribution == OWN
        }
        assert installed == declared.pop(kind.entry_points, set()), (
            "install again: pip install -e ."
        )
    assert not declared, "an entry-point group of no kind"
    (script,) = metadata.entry_points(group="console_scripts", name="cfx")
    assert script.value == PYPROJECT["project"]["scripts"]["cfx"]


def test_the_wheel_holds_the_package_and_its_config_files(tmp_path: Path) -> None:
    script = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    conf = {
        f"cfx/conf/{path.relative_to(ROOT / 'conf').as_posix()}"
        for path in (ROOT / "conf").rglob("*.yaml")
    }
    assert conf <= names
    assert {"cfx/CITATION.cff", "cfx/app/cli.py", "cfx/py.typed", "cfx/models/krauss.py"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "conf/", "outputs/"))]


def test_conf_is_found_in_a_checkout_and_in_an_installed_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (nodes.conf_dir() / "config.yaml").is_file()
    (tmp_path / "cfx" / "conf").mkdir(parents=True)
    monkeypatch.setattr(cfx, "__file__", str(tmp_path / "cfx" / "__init__.py"))
    assert nodes.conf_dir() == tmp_path / "cfx" / "conf"


def test_every_dependency_is_pinned_within_its_range() -> None:
    project = PYPROJECT["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    wanted = [Requirement(text) for texts in lists for text in texts]
    pinned = pins()
    for requirement in wanted:
        name = canonicalize_name(requirement.name)
        if not name.startswith("cfx-"):  # its own parts have no pin
            assert name in pinned, f"{name}: make lock"
            assert requirement.specifier.contains(pinned[name], prereleases=True), (
                f"{name}=={pinned[name]}: make lock"
            )


def test_pins_are_plain_versions() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert "+" not in text, "a local version such as +cpu would exclude every other build"
    assert "file:" not in text
    assert not re.search(r"^cfx", text, re.MULTILINE)


def test_the_licence_is_whole() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert text.startswith("MIT License")
    assert "WITHOUT WARRANTY OF ANY KIND" in text


def test_the_image_is_built_from_all_that_the_wheel_needs() -> None:
    copied = set()
    for line in (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:1] == ["COPY"] and "--from=build" not in words:
            copied |= set(words[1:-1])
    let_through = set()
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        if line.startswith("!"):
            let_through.add(line.removeprefix("!"))
    assert copied == let_through
    wheel = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["only-include"], *wheel.get("force-include", {})}
    needed |= {PYPROJECT["project"]["readme"], *PYPROJECT["project"]["license-files"]}
    assert needed <= copied
