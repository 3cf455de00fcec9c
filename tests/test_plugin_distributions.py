"""The distributions in plugins/ build offline, announce components, use the public API."""

from __future__ import annotations

import ast
import configparser
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
import cfx_report.section  # noqa: F401 - adds the kind of sections
from cfx.core import registry

ROOT = Path(__file__).resolve().parent.parent
PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml"))
READERS = {
    "cfx.data.files",
    "cfx.data.pairs",
    "cfx.data.signals",
    "cfx.data.sites",
    "cfx.data.table",
    "cfx.data.tidy",
    "cfx.data.tracks",
}
FIGURES = {
    "cfx.figures.canvas",
    "cfx.figures.figure",
    "cfx.figures.job",
    "cfx.figures.text",
}
RESULTS = {
    "cfx.core.console",
    "cfx.core.distributions",
    "cfx.core.files",
    "cfx.core.progress",
    "cfx.calibration.identifiability",
    "cfx.calibration.settings",
    "cfx.calibration.posterior",
    "cfx.calibration.shards",
    "cfx.core.component",
    "cfx.core.job_folder",
    "cfx.core.storage",
    "cfx.data.style",
    "cfx.data.units",
    "cfx.evaluation.statistics",
    "cfx_forecasts.distributions",
    "cfx.evaluation.forecasts",
    "cfx.evaluation.headline",
    "cfx.evaluation.result",
    "cfx.evaluation.sites",
    "cfx.evaluation.tables",
    "cfx.learners.curves",
    "cfx.results.config",
    "cfx.results.provenance",
    "cfx.results.tracker",
}
PROTOCOLS = {
    "cfx.core.memory",
    "cfx.evaluation.closed_loop",
    "cfx.evaluation.protocols.finished",
    "cfx.evaluation.protocols.held_out",
    "cfx_forecasts.noise",
    "cfx.models.limits",
    "cfx.models.regimes",
    "cfx.models.vtype",
    "cfx.models.composed",
    "cfx.policies.core",
    "cfx.policies.heads.stochastic",
    "cfx.simulation.base",
    "cfx.policies.features",
    "cfx.simulation.kernel.compiler",
    "cfx.simulation.rollout",
}
POLICIES = {
    "cfx.calibration.losses",
    "cfx.core.parameters",
    "cfx.policies.checkpoint",
    "cfx.policies.context",
    "cfx.policies.ready",
    "cfx.policies.valid_range",
    "cfx.simulation.trajectory",
}
CONTRACTS = {
    "cfx.app.completion",
    "cfx.app.nodes",
    "cfx.calibration.cache",
    "cfx.calibration.calibrator",
    "cfx.calibration.contract",
    "cfx.calibration.random_search",
    "cfx.core.contract",
    "cfx.core.registry",
    "cfx.evaluation.metrics.contract",
    "cfx.evaluation.protocols.within_driver",
    "cfx.learners.imitation",
    "cfx.models.contract",
    "cfx.policies.contract",
    "cfx.policies.gru",
    "cfx.policies.heads",
    "cfx.policies.heads.base",
    "cfx.simulation.contract",
    "cfx.simulation.synthetic",
    "cfx.simulation.windows",
}
"""What cfx-contracts tries components with; no other plugin uses these."""

PUBLIC_MODULES = {"cfx", "cfx.errors", *READERS, *FIGURES, *RESULTS, *PROTOCOLS, *POLICIES} | {
    kind.base.partition(":")[0] for kind in registry.KINDS.values()
}
"""What a plugin may import from; docs/plugins.md says so."""

DOCUMENTED = {
    name
    for page in (ROOT / "docs" / "api").glob("*.md")
    for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
}
"""What the reference documents besides."""

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
        [sys.executable, ROOT / "tests" / "driver_examples.py", example],
        cwd=work,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    packages = done.stdout.splitlines()[0].split()
    assert len(packages) == 4
    assert all(Path(package).parent == site for package in packages)
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
    kinds = (*registry.KINDS.values(), *registry.PARTS.values())
    groups = {kind.entry_points: kind.name for kind in kinds}
    points = project(plugin)["entry-points"]
    assert isinstance(points, dict)
    points.pop(registry.API_GROUP, None)  # the version of the plugin API, which is no component
    assert set(points) <= set(groups)
    for group, announced in points.items():
        for name, target in announced.items():
            found = registry.entry(groups[group], name)
            assert (found.distribution, found.target) == (plugin.name, target), (
                "install again: make test"
            )
            assert registry.get(groups[group], name)


def private_uses(path: Path) -> list[str]:
    """Returns what a file uses of cfx that is not public, with the line."""
    wrong = []
    also = CONTRACTS if "cfx-contracts" in path.parts else set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        used: list[tuple[str, str]] = []
        if isinstance(node, ast.Import):
            used = [
                (alias.name, "") for alias in node.names if alias.name.partition(".")[0] == "cfx"
            ]
        elif (
            isinstance(node, ast.ImportFrom)
            and node.module is not None
            and node.module.partition(".")[0] == "cfx"
        ):
            used = [(node.module, alias.name) for alias in node.names]
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "cfx"
        ):
            used = [("cfx", node.attr)]
        wrong += [
            f"{path.name}:{node.lineno}: {module} {name}".rstrip()
            for module, name in used
            if not is_public(module, name, also)
        ]  # type: ignore[attr-defined]  # statements and expressions have a line
    return wrong


def is_public(module: str, name: str, also: set[str]) -> bool:
    """Says whether a plugin may use `name` of `module`; "" is the module itself."""
    if module == "cfx":
        return name in {"", *cfx.__all__}
    if f"{module}.{name}" in DOCUMENTED | PUBLIC_MODULES | also:
        return True
    return module in PUBLIC_MODULES | also and not any(
        part.startswith("_") for part in (*module.split("."), name)
    )


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_it_uses_the_public_api_alone(plugin: Path) -> None:
    files = sorted((plugin / plugin.name.replace("-", "_")).rglob("*.py"))
    assert files
    wrong = [text for path in files for text in private_uses(path)]
    assert not wrong, "\n".join(wrong)


def test_the_check_of_imports_sees_what_is_private(tmp_path: Path) -> None:
    path = tmp_path / "plugin.py"
    path.write_text(
        "import cfx\nimport cfx.core.registry\nfrom cfx import nodes, Settings\n"
        "from cfx.data.describe import describe\nfrom cfx.models.base import DrivingModel, _x\n"
        "from cfx.core.contract import once\ncfx.job\ncfx.get\n"
    )
    assert [text.partition(": ")[2] for text in private_uses(path)] == [
        "cfx.core.registry",
        "cfx nodes",
        "cfx.data.describe describe",
        "cfx.models.base _x",
        "cfx.core.contract once",
        "cfx job",
    ]
