"""The compiler of training is a room with a door, and training does without it."""

from __future__ import annotations

import ast
import json
import logging
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import cfx
from cfx.learners.rollout import RolloutLearner, module
from cfx.learners.rollout.settings import RolloutSettings
from cfx.models.krauss import Krauss
from cfx.policies.heads import head_class
from cfx.simulation.kernel import compiler
from tests.learners.made import QUICK, gru, module_with, placed, training_data

PACKAGE = Path(cfx.__file__).parent
ROOM = "cfx.learners.compiled"

TOLERANCE = 1e-3
"""Relative difference of losses after the gradient steps below: networks learn in float32, and
compiled code adds up in another order. Gradients through more than ten observed windows would
differ by a thousandth of their own (`cfx.learners.compiled.loop`); here are fewer."""

needs_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")


def imports_below_the_door(path: Path) -> list[str]:
    """Returns what a file imports of the room other than the room itself."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom):
            names = [str(node.module)]
            if node.module == "cfx.learners":
                names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            if name.startswith(f"{ROOM}."):
                found.append(f"{path}: {name}")
    return found


def test_nothing_outside_imports_anything_below_the_door() -> None:
    found = []
    for folder in (PACKAGE, PACKAGE.parent / "plugins"):
        for path in folder.rglob("*.py"):
            if PACKAGE / "learners" / "compiled" not in path.parents:
                found += imports_below_the_door(path)
    assert not found, "\n".join(found)


SCRIPT = """
import json, sys
sys.path[:0] = [{tree!r}, {checkout!r}]
import cfx.learners
from cfx.learners.rollout import RolloutLearner
from cfx.learners.rollout.window import WindowStep
from tests.learners.made import QUICK, gru, training_data
assert cfx.learners.__file__.startswith({tree!r})
if not {by_torch}:
    WindowStep.compile = lambda step: None
result = RolloutLearner(**(QUICK | {options!r})).fit(gru(), training_data(networks=1))
print(json.dumps(result.curves[["train_loss", "validation_loss"]].to_numpy().tolist()))
"""


@needs_compiler
@pytest.mark.parametrize("by_torch", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_training_does_without_the_room(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, by_torch: bool
) -> None:
    """A copy of the package without the room trains the same networks, eagerly or compiled."""
    options = {"compile": "always", "epochs": 2, "steps": 3, "horizon": 3}
    with caplog.at_level(logging.INFO):
        result = RolloutLearner(**(QUICK | options)).fit(gru(), training_data(networks=1))
    assert "PyTorch compiles a window" not in caplog.text
    shutil.copytree(PACKAGE, tmp_path / "cfx", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(tmp_path / "cfx" / "learners" / "compiled")
    script = SCRIPT.format(
        tree=str(tmp_path), checkout=str(PACKAGE.parent), options=options, by_torch=by_torch
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    losses = torch.tensor(json.loads(done.stdout.splitlines()[-1]))
    expected = torch.tensor(result.curves[["train_loss", "validation_loss"]].to_numpy())
    torch.testing.assert_close(losses.double(), expected, rtol=TOLERANCE, atol=0.0)


def a_module(model: Any = None, **options: Any) -> module.RolloutModule:
    """Returns a module whose windows are compiled as the options say."""
    data, policy = training_data(model=model, networks=1), gru()
    settings = RolloutSettings(**(QUICK | options))
    dataset = placed(data, policy)
    head = head_class(settings.head).for_model(data.stepper.model)
    network = module.untrained(policy, dataset, head, torch.Generator().manual_seed(0))
    return module_with(network, dataset, data, settings, policy)


@needs_compiler
def test_one_setting_leaves_everything_to_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    by_torch: list[object] = []

    def record(step: module.WindowStep) -> None:
        by_torch.append(step)

    monkeypatch.setattr(module.WindowStep, "compile", record)
    monkeypatch.setattr(module, "_WORTH_COMPILING", 0)
    for setting, has_loops, windows in (
        ("auto", True, 0),
        ("torch", False, 1),
        ("never", False, 0),
    ):
        by_torch.clear()
        assert bool(a_module(compile=setting).compiled) is has_loops
        assert len(by_torch) == windows
    monkeypatch.setattr(module, "_WORTH_COMPILING", 10**9)
    by_torch.clear()
    assert not a_module(compile="torch").compiled
    assert not by_torch


@needs_compiler
def test_models_that_this_process_alone_knows_share_no_code() -> None:
    """Two classes made in functions have no lasting key: each is recorded anew."""

    def krauss(factor: float) -> Krauss:
        class Local(Krauss):
            def next_speed(self, *args: Any, **kwargs: Any) -> torch.Tensor:
                return super().next_speed(*args, **kwargs) * factor

        return Local()

    losses = []
    for factor in (1.0, 0.9):
        built = a_module(krauss(factor), compile="always")
        assert built.compiled
        batch = built.sampler.validation_with_history()
        divisors = built.shard.errors.over_horizon(batch)
        with torch.no_grad():
            compiled = next(built.simulated(built.exact_step, batch, 3))
            built.compiled = {}
            eager = next(built.simulated(built.exact_step, batch, 3))
        losses.append(built.trajectory_loss(compiled, divisors))
        losses.append(built.trajectory_loss(eager, divisors))
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses[2], losses[3], rtol=1e-4, atol=1e-5)
