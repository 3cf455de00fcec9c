"""The house: every module imports from clean, imports go one way, and light modules stay light."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
import textwrap
from pathlib import Path

import cfx

PACKAGE = Path(cfx.__file__).parent

FLOORS = (
    ("errors",),
    ("core",),
    ("data", "models"),
    ("simulation",),
    ("calibration", "policies"),
    ("learners",),
    ("evaluation",),
    ("figures",),
    ("results",),
    ("app",),
    ("api",),
    ("sklearn",),
    ("plugin",),
)
"""From the ground up; a room may use rooms on its own floor and below."""

HEIGHT = {room: height for height, floor in enumerate(FLOORS) for room in floor}

HEAVY = (
    "torch",
    "lightning",
    "mlflow",
    "pandas",
    "matplotlib",
    "scipy",
)


def modules() -> list[str]:
    """Returns the names of all modules of the package."""
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        if parts[-1] != "__main__":
            names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return names


def room(module: str) -> str:
    """Returns the first name below `cfx`, "" for cfx itself."""
    return [*module.split("."), ""][1]


def imported_by(path: Path) -> set[str]:
    """Returns the rooms that a file imports when it runs, also inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.If)
            and isinstance(node.test, ast.Name)
            and node.test.id == "TYPE_CHECKING"
        ):
            node.body = []
    rooms = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            rooms |= {
                room(alias.name) for alias in node.names if alias.name.partition(".")[0] == "cfx"
            }
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "cfx":
            rooms |= {room(f"{node.module}.{alias.name}") for alias in node.names}
    return rooms - {""}


def test_every_module_has_its_floor() -> None:
    assert {room(name) for name in modules()} - {""} == set(HEIGHT)


def test_imports_go_one_way() -> None:
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        here = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if here in {"__init__", "__main__"}:
            continue
        wrong += [
            f"{path.relative_to(PACKAGE)} imports cfx.{there}"
            for there in imported_by(path)
            if there in HEIGHT and HEIGHT[there] > HEIGHT[here]
        ]
    assert not wrong, "\n".join(wrong)


def source_of(module: str) -> Path:
    """Returns the file of a module."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def imported_anywhere(module: str, known: set[str]) -> set[str]:
    """Returns the modules that a module names in an import: in functions and for types alone too.

    The package's own `__init__` is left out: it comes before every module.
    """
    found: set[str] = set()
    for node in ast.walk(ast.parse(source_of(module).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                found.add(name if name in known else str(node.module))
    return (found & known) - {module, "cfx"}


def test_every_module_imports() -> None:
    script = f"import importlib\nfor name in {modules()!r}: importlib.import_module(name)"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_no_import_comes_back_to_where_it_began() -> None:
    names = set(modules())
    graph = {name: imported_anywhere(name, names) for name in names - {"cfx"}}
    assert "cfx.models.base" in graph["cfx.models.krauss"]
    assert "cfx.app.job.run" in graph["cfx.app.application"], "within functions"
    assert "cfx.results.result" in graph["cfx.app.job.run"], "for types alone"
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


AT_ONCE = (
    "import cfx.app.application, cfx.app.nodes; assert 'numpy' not in sys.modules",
    "main(['--help']); assert 'numpy' not in sys.modules",
    "import cfx.core.component, cfx.core.parameters, cfx.data.pairs, cfx.core.registry",
    "main(['plugins'])",
    "main(['--cfg', 'job', 'model=w99', 'data=tidy'])",
    "main(['modle=w99'])",
)


def test_what_must_answer_at_once_imports_nothing_heavy() -> None:
    """In one process, from the lightest on: what one of them imported would be seen there."""
    script = f"""
        import sys
        import cfx
        from cfx.app.cli import main
        for code in {AT_ONCE!r}:
            exec(code)
            loaded = sys.modules.keys() & set({HEAVY!r})
            assert not loaded, (code, loaded)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_wrong_path_is_answered_before_anything_heavy_is_imported(tmp_path: Path) -> None:
    script = f"""
        import sys
        import cfx.data.describe, cfx.simulation.synthetic
        from cfx.errors import DataError
        from cfx.results.config import JobConfig
        from cfx.app.job.run import run_job
        from pathlib import Path

        nodes = dict.fromkeys(("model", "policy", "optimizer", "learner", "protocol"), {{}})
        data = {{"name": "tidy", "path": "nowhere.parquet"}}
        try:
            run_job(JobConfig(data=data, **nodes), Path({str(tmp_path)!r}))
        except DataError as error:
            assert "no such file" in str(error), error
        else:
            raise AssertionError("there is no such file")
        heavy = {{"torch", "lightning", "mlflow", "scipy", "matplotlib"}} & set(sys.modules)
        assert not heavy, heavy
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
