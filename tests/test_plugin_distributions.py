"""The distributions in plugins/ build offline, announce components, use the public API."""

from __future__ import annotations

import ast
import configparser
import importlib
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import cfx
import cfx.plugin
from cfx.core import registry
from tests.checkout import ROOT, require_distributions
from tests.printed import blocks

require_distributions()

PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml"))
DOORS = ("cfx", "cfx.plugin", "cfx.errors", "cfx.sklearn")
"""What a plugin may import of cfx. `cfx_contracts` is a door itself: it looks at all that it tests."""

BUILD = """
import os, sys
from hatchling.build import build_wheel
for source in sys.argv[2:]:
    os.chdir(source)
    build_wheel(sys.argv[1])
"""


def project(plugin: Path) -> dict[str, object]:
    """Returns the table `project` of a plugin's pyproject.toml."""
    table: dict[str, object] = tomllib.loads(
        (plugin / "pyproject.toml").read_text(encoding="utf-8")
    )["project"]
    return table


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Builds all wheels in one process, without isolation and so offline; by distribution."""
    folder = tmp_path_factory.mktemp("wheels")
    done = subprocess.run(
        [sys.executable, "-c", BUILD, folder, *PLUGINS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return {path.name.split("-")[0].replace("_", "-"): path for path in folder.glob("*.whl")}


@pytest.mark.slow
def test_the_examples_of_drivers_elsewhere_run_from_wheels(
    wheels: dict[str, Path], tmp_path: Path
) -> None:
    """ONNX, FMI, Gymnasium and highway-env; the graph and the unit drive the same follower."""
    site, work = tmp_path / "site", tmp_path / "work"
    work.mkdir()
    build = [sys.executable, "-c", BUILD, tmp_path, ROOT]
    subprocess.run(build, capture_output=True, check=True)
    for wheel in (*wheels.values(), *tmp_path.glob("cfx_driving-*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
    example = ROOT / "plugins" / "cfx-drivers" / "examples" / "platoon.py"
    done = subprocess.run(
        [
            sys.executable,
            ROOT / "plugins" / "cfx-drivers" / "tests" / "driver_examples.py",
            example,
        ],
        cwd=work,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    packages = done.stdout.splitlines()[0].split()
    assert len(packages) == 4
    assert all(Path(package).is_relative_to(site) for package in packages)
    apart = re.search(r"unit apart (\S+) m/s", done.stdout)
    assert apart is not None
    assert float(apart[1]) < 1e-6


def test_there_are_plugins_and_no_other_folders() -> None:
    assert len(PLUGINS) >= 2
    folders = {
        path
        for path in (ROOT / "plugins").iterdir()
        if path.is_dir() and path.name != "__pycache__"
    }
    assert folders == set(PLUGINS), "a folder in plugins/ is a distribution, with a pyproject.toml"


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_the_wheel_holds_the_package_its_licence_and_its_entry_points(
    plugin: Path, wheels: dict[str, Path]
) -> None:
    declared = project(plugin)
    assert declared["name"] == plugin.name
    package = plugin.name.replace("-", "_")
    with zipfile.ZipFile(wheels[plugin.name]) as archive:
        names = set(archive.namelist())
        info = next(name.partition("/")[0] for name in names if ".dist-info/" in name)
        metadata = Parser().parsestr(archive.read(f"{info}/METADATA").decode("utf-8"))
        points = configparser.ConfigParser(delimiters=("=",))
        points.read_string(archive.read(f"{info}/entry_points.txt").decode("utf-8"))
    source = {
        path.relative_to(plugin).as_posix()
        for path in (plugin / package).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert source <= names
    assert {f"{package}/py.typed", f"{info}/licenses/LICENSE"} <= names
    assert not [name for name in names if name.startswith("tests/")]
    assert {group: dict(points[group]) for group in points.sections()} == declared["entry-points"]
    assert metadata["Version"] == declared["version"]
    assert any(
        text.replace(" ", "").startswith("cfx-driving")
        for text in metadata.get_all("Requires-Dist", [])
    )
    assert len(metadata.get_payload()) > 500, "the README is the page of the distribution"


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_what_it_announces_is_installed_here_and_loads(plugin: Path) -> None:
    groups = {kind.entry_points: kind.name for kind in registry.every_kind().values()}
    points = project(plugin)["entry-points"]
    assert isinstance(points, dict)
    points.pop(registry.API_GROUP, None)  # the version of the plugin API, which is no component
    for name, target in points.pop(registry.KINDS_GROUP, {}).items():
        assert registry.kind_of(name).base == target
    assert set(points) <= set(groups)
    for group, announced in points.items():
        for name, target in announced.items():
            found = registry.entry(groups[group], name)
            assert (found.distribution, found.target) == (plugin.name, target), (
                "install again: make test"
            )
            assert registry.get(groups[group], name)


def beside_the_doors(path: Path) -> list[str]:
    """Returns what a file uses of cfx that stands behind no door, with the line."""
    wrong = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    opened = set()  # names of the door that are modules, where this file imports them
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "cfx.plugin":
            opened |= {alias.name for alias in node.names} & set(cfx.plugin.MODULES)
    for node in ast.walk(tree):
        modules: list[tuple[str, str]] = []
        if isinstance(node, ast.Import):
            modules = [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [(str(node.module), alias.name) for alias in node.names]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == "cfx":
                modules = [("cfx", node.attr)]
            elif node.value.id in opened:
                modules = [(f"cfx.plugin.{node.value.id}", node.attr)]
        for module, name in modules:
            if module.partition(".")[0] == "cfx" and not is_public(module, name):
                wrong.append(f"{path.name}:{node.lineno}: {module} {name}".rstrip())
    return wrong


def is_public(module: str, name: str) -> bool:
    """Says whether a plugin may use `name` of `module`; "" is the module itself."""
    parent, _, last = module.rpartition(".")
    if parent == "cfx.plugin" and last in cfx.plugin.MODULES:
        return name in getattr(cfx.plugin, last).__all__
    if module not in DOORS:
        return False
    return module not in {"cfx", "cfx.plugin"} or name in {"", *sys.modules[module].__all__}


@pytest.mark.parametrize(
    "plugin", [path for path in PLUGINS if path.name != "cfx-contracts"], ids=lambda path: path.name
)
def test_it_uses_the_doors_alone(plugin: Path) -> None:
    files = sorted((plugin / plugin.name.replace("-", "_")).rglob("*.py"))
    assert files
    wrong = [text for path in files for text in beside_the_doors(path)]
    assert not wrong, "\n".join(wrong)


def needed_by(name: str) -> set[str]:
    """Returns a distribution and those of cfx that it depends on, and what is in every test."""
    needed = {name, "cfx-contracts"}
    for requirement in project(ROOT / "plugins" / name)["dependencies"]:
        other = re.match(r"[\w-]+", requirement)[0]
        if other.startswith("cfx-") and other != "cfx-driving":
            needed |= needed_by(other)
    return needed


def imported_unasked(path: Path, needed: set[str]) -> list[str]:
    """Returns what a test file imports of other distributions before `importorskip` asks for it."""
    asked, wrong = {name.replace("-", "_") for name in needed}, []
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        modules = []
        if isinstance(statement, ast.Import):
            modules = [alias.name for alias in statement.names]
        elif isinstance(statement, ast.ImportFrom) and statement.level == 0:
            modules = [str(statement.module)]
        elif "importorskip" in ast.dump(statement):
            asked |= set(re.findall(r"\bcfx_\w+", ast.unparse(statement)))
        for module in modules:
            package = module.partition(".")[0]
            if package.startswith("cfx_") and package not in asked:
                wrong.append(f"{path}:{statement.lineno}: {module}")
    return wrong


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_its_tests_import_beside_the_core_alone(plugin: Path) -> None:
    """`make beside` runs them there."""
    needed, wrong = needed_by(plugin.name), []
    for path in sorted((plugin / "tests").rglob("*.py")):
        wrong += imported_unasked(path, needed)
    assert not wrong, "\n".join(wrong)


def test_an_import_of_another_distribution_has_to_be_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "test_it.py"
    path.write_text("from cfx_sumo import x\n")
    assert imported_unasked(path, {"cfx-report"}) == [f"{path}:1: cfx_sumo"]
    path.write_text('import pytest\npytest.importorskip("cfx_sumo")\nfrom cfx_sumo import x\n')
    assert not imported_unasked(path, {"cfx-report"})


def test_templates_examples_and_documents_use_the_doors_alone(tmp_path: Path) -> None:
    wrong = []
    templates = ROOT / "plugins" / "cfx-contracts" / "cfx_contracts" / "template"
    for template in templates.rglob("*.py.jinja"):
        path = tmp_path / f"{template.parents[1].name} {template.stem}"
        path.write_text(re.sub(r"\{\{ (\w+) \}\}", r"\1", template.read_text("utf-8")))
        wrong += beside_the_doors(path)
    for path in ROOT.glob("plugins/*/examples/**/*.py"):
        wrong += beside_the_doors(path)
    for path in ROOT.glob("docs/tutorials/*.py"):
        wrong += beside_the_doors(path)
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("plugins/*/README.md")]
    for page in pages:
        if page.parent == ROOT / "docs" / "development":
            continue  # for those who change cfx
        for number, block in enumerate(blocks(page.relative_to(ROOT).as_posix(), "python")):
            path = tmp_path / f"{page.parent.name} {page.stem} {number}"
            path.write_text(block, encoding="utf-8")
            wrong += beside_the_doors(path)
    assert not wrong, "\n".join(wrong)


def test_the_check_of_doors_sees_what_stands_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "plugin.py"
    path.write_text(
        "import cfx\nimport cfx.core.registry\nfrom cfx import nodes, read\n"
        "from cfx.data.describe import describe\nfrom cfx.plugin import DrivingModel, _x, gone\n"
        "from cfx.plugin import threads\nthreads.cores()\nthreads.gone()\n"
        "from cfx.errors import DataError\ncfx.job\ncfx.get\nimport cfxtra\n"
    )
    assert [text.partition(": ")[2] for text in beside_the_doors(path)] == [
        "cfx.core.registry",
        "cfx nodes",
        "cfx.data.describe describe",
        "cfx.plugin _x",
        "cfx.plugin gone",
        "cfx job",
        "cfx.plugin.threads gone",
    ]


@pytest.mark.parametrize("door", ["cfx", "cfx.plugin"])
def test_what_a_door_lists_is_there(door: str) -> None:
    module = importlib.import_module(door)
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = module.nonsense


def test_the_names_that_are_modules_are_those_of_the_stub() -> None:
    stub = ast.parse((ROOT / "cfx" / "plugin.pyi").read_text(encoding="utf-8"))
    modules = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                place = f"cfx.{node.module}.{alias.name}"
                if (ROOT / f"{place.replace('.', '/')}.py").is_file():
                    modules[alias.name] = place
    assert modules == cfx.plugin.MODULES


def test_a_name_stands_in_one_door() -> None:
    assert not set(cfx.__all__) & set(cfx.plugin.__all__)
