"""Plugins that fail late: one sentence that names the distribution and the line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cfx.app import cli
from cfx.core.registry import blame
from tests.broken_plugins import POLICY, QUICK

Job = Callable[[str, str, str], tuple[int, str]]

MODEL = """
import torch
from cfx.plugin import DrivingModel, Parameter, ParameterSpace

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


@pytest.fixture
def job(install: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Job:
    """Runs a quick job with one component of a third party, a distribution of one module.

    The job gets `GROUP=NAME`, the distribution's name and the module's text; its class is the last
    part of the text that is a component. It gives the exit code and what stood on stderr.
    """

    def run(override: str, distribution: str, text: str) -> tuple[int, str]:
        group, _, name = override.partition("=")
        module = distribution.replace("-", "_")
        kind = {"policy": "policies"}.get(group, f"{group}s")
        target = re.findall(r"^class (\w+)\((?:DrivingModel|Policy|Optimizer)\)", text, re.M)[-1]
        install(distribution, {f"cfx.{kind}": {name: f"{module}:{target}"}}, {f"{module}.py": text})
        overrides = [one for one in QUICK if not one.startswith((f"{group}=", f"{group}."))]
        code = cli.main([*overrides, override, f"hydra.run.dir={tmp_path / 'job'}"])
        return code, capsys.readouterr().err

    return run


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
    failure: str, said: str, job: Job, tmp_path: Path
) -> None:
    code, err = job("model=late", "late-models", MODEL.replace("{failure}", failure))
    assert code == 2
    assert "late-models" in err
    assert "failed in late_models.py, line 1" in err
    assert said in err
    assert "Traceback" not in err
    said_of_it = [line for line in err.splitlines() if not line.startswith("split=")]
    assert len(said_of_it) == 1, "besides the short test part of these made-up pairs"
    assert "Traceback" in (tmp_path / "job" / "cfx.log").read_text()
    assert not (tmp_path / "job" / "metrics.json").exists()


def test_errors_of_cfx_itself_are_nobody_elses() -> None:
    from cfx.core.parameters import ParameterSpace

    with pytest.raises(AttributeError) as caught:
        ParameterSpace(()).from_unit(None)  # type: ignore[arg-type]
    assert blame(caught.value) is None


MIXED = """
import torch
from cfx.plugin import Optimizer

class Mixed(Optimizer):
    def evaluations(self, n):
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


def test_an_optimizer_that_mixes_up_candidates_and_losses_is_refused(job: Job) -> None:
    code, err = job("optimizer=mixed", "mixed-optimizers", MIXED)
    assert code == 2
    assert "mixed-optimizers" in err
    assert "candidates with losses that are not theirs" in err


def test_a_model_that_changes_its_inputs_is_refused(job: Job) -> None:
    text = MODEL.replace("        STEPS.append(1)\n", "        leader.speed.mul_(0.9)\n")
    text = text.replace("        if len(STEPS) > 300:\n            {failure}\n", "")
    code, err = job("model=late", "late-models", text)
    assert code == 2
    assert "late-models" in err
    assert "a step changes leader.speed in place" in err


LATE_NAN = """
CALLS = []

def late(answer):
    CALLS.append(1)
    return answer * float("nan") if len(CALLS) > 6 else answer
"""


def test_a_policy_that_answers_no_number_is_refused(job: Job) -> None:
    code, err = job("policy=void", "nan-policies", POLICY.format("late(answer)") + LATE_NAN)
    assert code == 2
    assert "nan-policies" in err
    assert "answer numbers that are not finite" in err


def test_a_plugins_files_never_replace_hydras_own(
    install: Any, caplog: pytest.LogCaptureFixture
) -> None:
    from cfx.app.hydra_source import composed

    files = {
        "shadow_models/__init__.py": MODEL.replace("{failure}", "pass"),
        "shadow_models/conf/hydra/launcher/basic.yaml": "_target_: nowhere.Launcher\n",
        "shadow_models/conf/model/shadow_far.yaml": "defaults: [_shadow]\n",
    }
    install("shadow-models", {"cfx.models": {"shadow": "shadow_models:Late"}}, files)
    config = composed([])
    assert config.hydra.launcher._target_.startswith("hydra.")
    assert "shadow_models brings hydra/launcher/basic.yaml" in caplog.text
    assert composed(["model=shadow"]).model.name == "shadow"
