"""An FMU passes FMPy's checks and drives as cfx's own step does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cfx.app.cli import main
from cfx.policies.checkpoint import save_agent
from cfx.policies.driver_step import DriverStep, Motion
from tests.agents import adaptive

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install fmpy")
validation = pytest.importorskip("fmpy.validation")
pytest.importorskip("pythonfmu3", reason="needs PythonFMU3: pip install pythonfmu3")

STEPS = 60


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unit") / "job"
    save_agent(adaptive({"name": "idm"}), folder / "policy")
    assert main(["export", str(folder), "--to", "fmi"]) == 0
    return folder / "driver.fmu"


def test_it_keeps_to_fmi_3_and_says_units(unit: Path) -> None:
    assert validation.validate_fmu(str(unit)) == []
    description = fmpy.read_model_description(str(unit))
    assert description.fmiVersion == "3.0"
    assert description.coSimulation.needsExecutionTool
    units = {one.name: (one.causality, one.unit) for one in description.modelVariables}
    assert units["gap"] == ("input", "m")
    assert units["leader_acceleration"] == ("input", "m/s2")
    assert units["next_speed"] == ("output", "m/s")
    assert description.defaultExperiment.stepSize == "0.1"


def inputs() -> np.ndarray:
    """Returns what a driver sees in each step: a leader that brakes and goes on."""
    names = ("time", "ego_speed", "ego_acceleration", "leader_speed", "leader_acceleration", "gap")
    rows = np.zeros(STEPS, dtype=[(name, float) for name in names])
    time = rows["time"] = 0.1 * np.arange(STEPS)
    rows["leader_speed"], rows["leader_acceleration"] = 10 + np.sin(time), np.cos(time)
    rows["ego_speed"], rows["gap"] = 10 + 0.5 * np.sin(time), 20 + 2 * np.cos(time)
    rows["ego_acceleration"] = 0.5 * np.cos(time)
    return rows


def test_it_drives_as_cfx_does(unit: Path) -> None:
    rows = inputs()
    found = fmpy.simulate_fmu(
        str(unit),
        stop_time=0.1 * (STEPS - 1),
        step_size=0.1,
        output_interval=0.1,
        input=rows,
        output=["next_speed"],
    )
    step = DriverStep(adaptive({"name": "idm"}))
    state, expected = step.begin(1), []
    for row in rows[:-1]:
        v, a, v_l, a_l, gap = (torch.tensor([row[name]]) for name in rows.dtype.names[1:])
        speed, state = step(state, Motion(v, a), Motion(v_l, a_l), gap)
        expected.append(float(speed))
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(found["next_speed"][1:], expected, atol=1e-5)


def next_speed(unit: Path, gap: float) -> float:
    """Returns the speed after one step, m/s, of a driver at 10 m/s behind a leader as fast."""
    starts = {"ego_speed": 10.0, "leader_speed": 10.0, "gap": gap}
    found = fmpy.simulate_fmu(
        str(unit),
        stop_time=0.1,
        step_size=0.1,
        output_interval=0.1,
        start_values=starts,
        output=["next_speed"],
    )
    return float(found["next_speed"][1])


def test_nobody_ahead_is_a_free_road_and_no_number_is_an_error(unit: Path) -> None:
    step = DriverStep(adaptive({"name": "idm"}))
    motion = Motion(torch.tensor([10.0]).double(), torch.zeros(1).double())
    speed, _ = step(step.begin(1), motion, motion, torch.tensor([np.inf]).double())
    assert next_speed(unit, np.inf) == pytest.approx(float(speed), abs=1e-5)
    with pytest.raises(Exception, match="fmi3DoStep"):
        next_speed(unit, np.nan)


def test_a_communication_step_of_another_length_is_an_error(unit: Path) -> None:
    with pytest.raises(Exception, match="fmi3DoStep"):
        fmpy.simulate_fmu(str(unit), stop_time=1.0, step_size=0.25, output_interval=0.25)
