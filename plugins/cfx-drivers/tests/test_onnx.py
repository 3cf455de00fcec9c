"""An exported driver: it drives as cfx does, says what it is, and needs ONNX Runtime alone."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.app.cli import main
from cfx.errors import ConfigError, DataError
from cfx.policies.base import PolicyNetwork
from cfx.policies.checkpoint import load_agent, save_agent
from cfx.policies.core import AgentCore
from cfx.policies.driver_step import DriverStep, Motion
from cfx.results.tracker import folder_of
from cfx_drivers.gym.drivers import driver_step
from cfx_drivers.onnx.agreement import in_onnx_runtime, largest_difference
from cfx_drivers.onnx.export import MOST_DIFFERENCE, OnnxExport
from cfx_drivers.onnx.graph import graph_of
from tests.agents import adaptive
from tests.further import known_inputs

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
PLATOON = EXAMPLES / "platoon.py"


def driven(step: DriverStep) -> NDArray[np.float64]:
    """The platoon of the example, driven by cfx: speeds of the leader and of ten followers."""
    random = np.random.default_rng(0)
    state = step.begin(10)
    speed, acceleration = torch.full((10,), 15.0).double(), torch.zeros(10).double()
    position = -30.0 * torch.arange(1, 11).double()
    v_l = torch.tensor([15.0]).double()
    x_l = torch.tensor([0.0]).double()
    rows = []
    for number in range(900):
        rows.append(torch.cat([v_l, speed]).numpy())
        now = -2.0 if 100 <= number < 140 else 1.0 if 240 <= number < 320 else 0.0
        a_l = torch.tensor([now]).double()
        leader = Motion(torch.cat([v_l, speed[:-1]]), torch.cat([a_l, acceleration[:-1]]))
        gap = torch.cat([x_l, position[:-1]]) - 5.0 - position
        noise = None
        if step.noise_width:
            noise = torch.from_numpy(random.standard_normal((10, step.noise_width)))
        after, state = step(state, Motion(speed, acceleration), leader, gap, noise)
        acceleration = (after - speed) / 0.1
        position, speed = position + after * 0.1, after
        v_l = v_l + a_l * 0.1
        x_l = x_l + v_l * 0.1
    return np.stack(rows)


@pytest.mark.slow
def test_a_stochastic_driver_drives_the_example_as_cfx_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has all parts that a driver may have: an ensemble, a residual, noise, memory."""
    path = tmp_path / "driver.onnx"
    assert main(["export", "cfx://idm-stochastic", "--to", "onnx", "--output", str(path)]) == 0
    assert "steps of 0.1 s" in capsys.readouterr().out
    assert path.stat().st_size < 1e6
    done = subprocess.run(
        [sys.executable, PLATOON, path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = np.array([line.split(",") for line in done.stdout.split()[1:]], dtype=float)[:, 1:]
    step = DriverStep(load_agent(folder_of("cfx://idm-stochastic") / "policy"))
    expected = driven(step)
    # Rounding in single precision, in which networks are, multiplies from vehicle to vehicle.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)

    graph = onnx.load(path)
    onnx.checker.check_model(graph, full_check=True)
    assert graph.opset_import[0].version == 20
    about = {one.key: one.value for one in graph.metadata_props}
    assert about["cfx.dt"] == "0.1 s"
    assert about["cfx.policy"] == "cfx://idm-stochastic"
    assert about["cfx.parameters"].startswith("v0 [m/s], T [s], s0 [m]")
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    for tensor in (*graph.graph.input, *graph.graph.output):
        assert about[f"unit.{tensor.name}"]
        assert f"| `{tensor.name}` |" in card
        assert tensor.type.tensor_type.shape.dim[0].dim_param == "drivers"
    assert "float (drivers, 128) | what the network remembers [1]" in card


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler, g++")
def test_the_example_in_cpp_drives_as_the_one_in_python(tmp_path: Path) -> None:
    found = find_spec("openvino")
    if found is None or found.origin is None:
        pytest.skip("needs OpenVINO: pip install openvino")
    openvino = Path(found.origin).parent
    (library,) = (openvino / "libs").glob("libopenvino.so.*")
    program = tmp_path / "platoon"
    built: list[str | Path] = ["g++", "-std=c++17", EXAMPLES / "cpp" / "platoon.cpp", "-o", program]
    built += [f"-I{openvino / 'include'}", library, f"-Wl,-rpath,{library.parent}"]
    subprocess.run(built, check=True)
    path = tmp_path / "driver.onnx"
    assert main(["export", "cfx://idm", "--to", "onnx", "--output", str(path)]) == 0
    commands: list[list[str | Path]] = [[program, path], [sys.executable, PLATOON, path]]
    ran = [subprocess.run(one, capture_output=True, text=True, check=True) for one in commands]
    rows = [[line.split(",") for line in done.stdout.split()[-900:]] for done in ran]
    in_cpp, in_python = np.array(rows, dtype=float)[..., 1:]
    difference = np.abs(in_cpp - in_python)
    assert difference[:, :2].max() < 1e-5
    # Rounding in single precision multiplies from vehicle to vehicle.
    assert difference.max() < 1e-3


def test_one_of_several_networks_is_named(tmp_path: Path) -> None:
    agent = adaptive({"name": "idm"}, ("one", "two"))
    save_agent(agent, tmp_path / "policy")
    with pytest.raises(DataError, match="2 networks"):
        OnnxExport().write(str(tmp_path), None)
    with pytest.raises(DataError, match="no network 'three'; it has one, two"):
        OnnxExport().write(f"{tmp_path}#three", None)
    OnnxExport().write(f"{tmp_path}#two", None)
    about = {one.key: one.value for one in onnx.load(tmp_path / "driver.onnx").metadata_props}
    assert about["cfx.model"] == "idm"
    assert about["cfx.policy"].endswith("#two")
    assert (tmp_path / "driver.md").is_file()


def test_nobody_ahead_is_a_free_road_and_no_number_stays_none() -> None:
    step = DriverStep(adaptive({"name": "idm"}))
    session = onnxruntime.InferenceSession(graph_of(step, "here").SerializeToString())
    values = {"ego_speed": 10.0, "ego_acceleration": 0.0, "leader_speed": 10.0}
    given = {
        name: np.full(3, value) for name, value in (values | {"leader_acceleration": 0.0}).items()
    }
    given["gap"] = np.array([20.0, np.inf, np.nan])
    for name, value in step.begin(3)._asdict().items():
        if value.numel():
            given[name] = value.numpy()
    speed = session.run(["next_speed"], given)[0]
    v, still = torch.full((2,), 10.0).double(), torch.zeros(2).double()
    gap = torch.tensor([20.0, np.inf]).double()
    expected, _ = step(step.begin(2), Motion(v, still), Motion(v, still), gap)
    np.testing.assert_allclose(speed[:2], expected.numpy(), rtol=0, atol=1e-5)
    assert np.isnan(speed[2])


class Branching(PolicyNetwork):
    """Answers by the values that it sees, in Python."""

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return torch.zeros((networks, drivers, 0))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        shape = (*tokens.shape[:3], 2)
        if bool((tokens > 0).any()):
            return torch.zeros(shape), state
        return torch.ones(shape), state


def test_further_signals_are_inputs_of_the_graph() -> None:
    with known_inputs():
        step = DriverStep(adaptive({"name": "idm"}, further=("rain", "second_leader")))
        graph = graph_of(step, "here")
        assert (
            largest_difference(step, in_onnx_runtime(graph.SerializeToString())) <= MOST_DIFFERENCE
        )
        with pytest.raises(ConfigError, match=r"'rain' reads the signal 'rain'.*this environment"):
            driver_step(step.agent)
    about = {one.key: one.value for one in graph.metadata_props}
    assert about["cfx.signals"].split()[5:] == ["rain", "second_leader_gap", "second_leader_speed"]
    assert (about["unit.rain"], about["meaning.rain"]) == ("mm/h", "rainfall")
    names = [tensor.name for tensor in graph.graph.input]
    assert {"rain", "second_leader_gap", "second_leader_speed"} <= set(names)


def test_a_policy_that_is_no_graph_is_refused() -> None:
    agent = adaptive({"name": "krauss"})
    core = agent.core
    core = AgentCore(core.policy, Branching(), core.scaler, core.head)
    with pytest.raises(ConfigError, match="policy=gru cannot be written as ONNX"):
        graph_of(DriverStep(replace(agent, core=core)), "here")


def test_an_unknown_format_is_answered_with_the_nearest(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["export", "cfx://idm", "--to", "onxx"]) == 2
    assert "there is no export 'onxx'. Did you mean 'onnx'?" in capsys.readouterr().err
