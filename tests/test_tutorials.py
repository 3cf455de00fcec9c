"""Tutorials run in a smoke mode, and their pages show the code of their files."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.checkout import ROOT
from tests.printed import blocks

FOLDER = ROOT / "docs" / "tutorials"


def runner() -> ModuleType:
    """Returns the module that runs tutorials; it lies beside them, in no package."""
    spec = importlib.util.spec_from_file_location("tutorial_runner", FOLDER / "run.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RUNNER = runner()


def test_every_tutorial_is_run() -> None:
    found = {path.stem for path in FOLDER.glob("*.py")} - {"run"}
    assert found == set(RUNNER.NAMES)


@pytest.mark.parametrize("name", RUNNER.NAMES)
def test_a_page_shows_the_code_of_its_file(name: str) -> None:
    """A page is written by `make tutorials`; whoever changes the file runs it again."""
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    code = [body for is_text, body in RUNNER.cells(text) if not is_text]
    assert [block.rstrip("\n") for block in blocks(f"docs/tutorials/{name}.md", "python")] == code
    page = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    for is_text, body in RUNNER.cells(text):
        assert not is_text or body in page
    assert " minutes and " in page.splitlines()[-1]


def test_cells_are_text_and_code() -> None:
    text = "# %% [markdown]\n# # Title\n#\n# Text\n\n# %%\na = 1\n\n# a comment\nb = 2\n"
    assert list(RUNNER.cells(text)) == [
        (True, "# Title\n\nText"),
        (False, "a = 1\n\n# a comment\nb = 2"),
    ]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", RUNNER.NAMES)
def test_a_tutorial_runs_small(name: str, tmp_path: Path) -> None:
    if name == "sumo":
        pytest.importorskip("libsumo", reason="SUMO is not here; pip install 'cfx-driving[sumo]'")
    done = subprocess.run(
        [sys.executable, FOLDER / "run.py", name],
        cwd=tmp_path,
        env={**os.environ, "CFX_SMOKE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
