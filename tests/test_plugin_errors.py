"""Plugins that fail late: one sentence that names the distribution and the line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cfx import cli
from cfx.plugin_errors import blame
from tests.broken_plugins import QUICK

MODEL = """
import torch
from cfx import DrivingModel, Parameter, ParameterSpace

STEPS = []

class Late(DrivingModel):
    parameters = ParameterSpace.of(
        Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap"),
        Parameter("a", "m/s2", 1.0, 3.0, 2.0, "maximum acceleration"),
    )

    def next_speed(self, follower, leader, p, dt):
        STEPS.append(1)
        if len(STEPS) > 300:
            {failure}
        gap = leader.position - leader.length - follower.position
        return torch.minimum(follower.speed + p["a"] * dt, gap / p["tau"]).clamp(min=0.0)
"""


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
        ("raise SystemExit(5)", "it called sys.exit(5)"),
        ("raise MemoryError", "memory ran out"),
        ("torch.zeros(2) + torch.zeros(3)", "RuntimeError: The size of tensor"),
    ],
)
def test_a_model_that_fails_late_is_named_with_its_line(
    failure: str,
    said: str,
    install: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = MODEL.replace("{failure}", failure)
    install("late-models", {"cfx.models": {"late": "late_models:Late"}}, {"late_models.py": text})
    overrides = [one for one in QUICK if not one.startswith("model=")]
    code = cli.main([*overrides, "model=late", f"hydra.run.dir={tmp_path / 'job'}"])
    err = capsys.readouterr().err
    assert code == 2
    assert "late-models" in err
    assert "failed in late_models.py, line 1" in err
    assert said in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert "Traceback" in (tmp_path / "job" / "cfx.log").read_text()
    assert not (tmp_path / "job" / "metrics.json").exists()


def test_errors_of_cfx_itself_are_nobody_elses() -> None:
    from cfx.parameters import ParameterSpace

    with pytest.raises(AttributeError) as caught:
        ParameterSpace(()).from_unit(None)  # type: ignore[arg-type]
    assert blame(caught.value) is None


MIXED = """
import torch
from cfx import Optimizer

class Mixed(Optimizer):
    def evaluations(self):
        return 8

    def bytes_per_problem(self, n):
        return 1000

    def solve(self, objective, guesses, *, seed):
        generator = torch.Generator().manual_seed(seed)
        shape = (len(guesses), 8 - guesses.shape[1], guesses.shape[2])
        more = torch.rand(shape, generator=generator, dtype=torch.float64)
        tried = torch.cat([guesses, more], 1)
        return tried.flip(1), objective(tried)
"""


def test_an_optimizer_that_mixes_up_candidates_and_losses_is_refused(
    install: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"mixed_optimizers.py": MIXED}
    install("mixed-optimizers", {"cfx.optimizers": {"mixed": "mixed_optimizers:Mixed"}}, files)
    overrides = [one for one in QUICK if not one.startswith("optimizer")]
    code = cli.main([*overrides, "optimizer=mixed", f"hydra.run.dir={tmp_path / 'job'}"])
    err = capsys.readouterr().err
    assert code == 2
    assert "mixed-optimizers" in err
    assert "candidates with losses that are not theirs" in err
