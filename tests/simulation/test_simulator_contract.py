"""cfx's own simulators, how configs choose them, and what third parties' must be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import cfx
from cfx.app.hydra_source import composed, plain
from cfx.app.job.run import run_job
from cfx.core import registry
from cfx.errors import ConfigError, PluginError
from cfx.models.krauss import Krauss
from cfx.results.config import JobConfig
from cfx.simulation.base import Simulator
from cfx.simulation.rollout import MemorySimulator, MemoryStepper
from tests.without_equations import WithoutEquations

QUICK = [
    "model=krauss",
    "learner=imitation",
    "protocol=within_driver",
    "data=synthetic",
    "data.pairs=2",
    "data.frames=150",
    "optimizer=random",
    "optimizer.samples=16",
    "calibration.prior=weak",
    "policy=fixed",
    "figures=none",
    "tracking.enabled=false",
    "cache.enabled=false",
]

HALVING = """
    from cfx.plugin import Simulator
    from cfx.simulation.rollout import MemoryStepper

    class Mine(Simulator):
        differentiable = True

        def stepper(self, model, dt):
            return Halving(model, dt)

    class Halving(MemoryStepper):
        def advance(self, follower, leader, p):
            return super().advance(follower, leader, {**p, "a": 0.5 * p["a"]})

        def identity(self):
            return "halving"
"""


def values_of(*overrides: str) -> dict[str, Any]:
    return plain(composed(overrides))


def test_it_is_the_public_name_and_memory_the_default() -> None:
    assert cfx.plugin.Simulator is Simulator
    assert cfx.get("simulator", "memory") is MemorySimulator
    made = registry.create("simulator", JobConfig.of(values_of()).simulator)
    assert isinstance(made, MemorySimulator)
    stepper = made.stepper(Krauss(), 0.1)
    assert isinstance(stepper, MemoryStepper)
    assert stepper.identity() == MemoryStepper(Krauss(), 0.1).identity()


def test_a_model_without_equations_is_refused_by_what_uses_equations() -> None:
    with pytest.raises(ConfigError, match=r"no equations in Python; add simulator=sumo, which"):
        MemorySimulator().require(WithoutEquations())


@pytest.fixture(scope="module")
def error(tmp_path_factory: pytest.TempPathFactory) -> float:
    """The error of driver-specific parameters, simulated as ever."""
    job = run_job(JobConfig.of(values_of(*QUICK)), tmp_path_factory.mktemp("memory") / "job")
    return float(job.metrics["rmse_speed/driver_specific"])


def test_a_third_partys_simulator_takes_the_steps_of_a_job(
    install: Any, tmp_path: Path, error: float
) -> None:
    install("mine-sims", {"cfx.simulators": {"mine": "mine_sims:Mine"}}, {"mine_sims.py": HALVING})
    theirs = run_job(JobConfig.of(values_of(*QUICK, "simulator=mine")), tmp_path / "mine")
    assert theirs.metrics["rmse_speed/driver_specific"] != error
    node = JobConfig.of(values_of("simulator=mine", "simulator.memory_mb=64")).simulator
    assert node == {"name": "mine", "memory_mb": 64}


@pytest.mark.parametrize(
    ("returned", "complaint"),
    [
        ("None", "stepper returns a NoneType and no Stepper"),
        ("Unnamed(model, dt)", r"identity\(\) must give a text"),
        ("Single(model, dt)", r"advance's positions gives torch.float32"),
        ("Short(model, dt)", r"advance's positions gives the shape \(4, 64\)"),
    ],
)
def test_a_broken_simulator_is_found_before_any_work(
    returned: str, complaint: str, install: Any
) -> None:
    text = f"""
        from cfx.plugin import Simulator
        from cfx.simulation.rollout import MemoryStepper

        class Unnamed(MemoryStepper):
            def identity(self):
                return 1

        class Single(MemoryStepper):
            def advance(self, *inputs):
                end, position, speed = super().advance(*inputs)
                return end, position.float(), speed.float()

        class Short(MemoryStepper):
            def advance(self, *inputs):
                end, position, speed = super().advance(*inputs)
                return end, position[1:], speed[1:]

        class Bad(Simulator):
            differentiable = True

            def stepper(self, model, dt):
                return {returned}
    """
    install("bad-sims", {"cfx.simulators": {"bad": "bad_sims:Bad"}}, {"bad_sims.py": text})
    with pytest.raises(PluginError, match=rf"bad-sims 1\.0 breaks its contract: .*{complaint}"):
        registry.create("simulator", {"name": "bad"})


def test_what_was_never_a_setting_is_refused_by_its_name() -> None:
    values = values_of()
    values["simulation"] = {"memory_gb": 1}
    with pytest.raises(ConfigError, match="simulation: unknown key"):
        JobConfig.of(values)


def test_shards_do_not_change_the_numbers(tmp_path: Path, error: float) -> None:
    """The bound of memory cuts the work into shards, and nothing else."""
    few = run_job(JobConfig.of(values_of(*QUICK, "simulator.memory_mb=16")), tmp_path)
    assert few.metrics["rmse_speed/driver_specific"] == error
