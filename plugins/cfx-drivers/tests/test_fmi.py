"""An FMU passes FMPy's checks and drives as cfx's own step does."""

from __future__ import annotations

import math
import shutil
import zipfile
from collections.abc import Callable, Iterator
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
fmi3 = pytest.importorskip("fmpy.fmi3")
if shutil.which("cc") is None:
    pytest.skip("needs a C compiler", allow_module_level=True)

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
    assert not description.coSimulation.needsExecutionTool
    assert description.coSimulation.canHandleVariableCommunicationStepSize
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


def test_it_needs_no_python(unit: Path) -> None:
    with zipfile.ZipFile(unit) as archive:
        names = archive.namelist()
    assert not [name for name in names if name.endswith((".py", ".onnx"))]
    assert [name for name in names if name.startswith("binaries/")]
    assert {"sources/unit.c", "sources/buildDescription.xml"} <= set(names)


class Unit:
    """An instance of the unit behind a leader that brakes and goes on; steps of any length."""

    def __init__(self, unit: Path, folder: Path, seed: int | None = None) -> None:
        description = fmpy.read_model_description(str(unit))
        self.references = {one.name: one.valueReference for one in description.modelVariables}
        self.slave = fmi3.FMU3Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(unit), str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="driver",
        )
        self.slave.instantiate()
        self.slave.enterInitializationMode()
        if seed is not None:
            self.slave.setInt32([self.references["seed"]], [seed])
        self.slave.exitInitializationMode()
        self.time, self.speed, self.acceleration, self.gap = 0.0, 10.0, 0.0, 20.0

    def advance(self, step: float) -> None:
        """Goes on by a step, in which both vehicles move by forward Euler."""
        leader, ahead = 10 + 2 * math.sin(self.time), 2 * math.cos(self.time)
        values = {
            "ego_speed": self.speed,
            "ego_acceleration": self.acceleration,
            "leader_speed": leader,
            "leader_acceleration": ahead,
            "gap": self.gap,
        }
        references = [self.references[name] for name in values]
        self.slave.setFloat64(references, list(values.values()))
        self.slave.doStep(self.time, step)
        outputs = [self.references["next_speed"], self.references["acceleration"]]
        self.speed, self.acceleration = self.slave.getFloat64(outputs)
        self.time += step
        self.gap += (10 + 2 * math.sin(self.time) - self.speed) * step

    def speeds(self, step: float, seconds: float) -> list[float]:
        """Returns the speeds after each second."""
        each = []
        for number in range(1, round(seconds / step) + 1):
            self.advance(step)
            if number % round(1 / step) == 0:
                each.append(self.speed)
        return each

    def close(self) -> None:
        self.slave.terminate()
        self.slave.freeInstance()


@pytest.fixture
def make(unit: Path, tmp_path: Path) -> Iterator[Callable[..., Unit]]:
    made: list[Unit] = []

    def of(source: Path = unit, seed: int | None = None) -> Unit:
        made.append(Unit(source, tmp_path / f"unit{len(made)}", seed))
        return made[-1]

    yield of
    for one in made:
        one.close()


@pytest.mark.parametrize(
    ("step", "tolerance"),
    [(0.01, 0.05), (0.02, 0.05), (0.05, 0.05), (0.25, 0.1), (0.5, 0.2), (1.0, 0.4)],
)
def test_steps_of_other_lengths_drive_alike(
    make: Callable[..., Unit], step: float, tolerance: float
) -> None:
    expected = make().speeds(0.1, 20.0)
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(make().speeds(step, 20.0), expected, atol=tolerance)


def test_a_state_is_gone_back_to(make: Callable[..., Unit]) -> None:
    driver = make()
    driver.speeds(0.1, 3.0)
    state = driver.slave.getFMUState()
    kept = vars(driver) | {}
    first = driver.speeds(0.05, 4.0)
    again = driver.slave.deserializeFMUState(driver.slave.serializeFMUState(state))
    driver.slave.setFMUState(again)
    vars(driver).update(kept)
    assert driver.speeds(0.05, 4.0) == first
    driver.slave.freeFMUState(state)
    driver.slave.freeFMUState(again)


def test_a_seed_says_what_is_left_to_chance(
    make: Callable[..., Unit], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("stochastic") / "job"
    save_agent(adaptive({"name": "idm"}, stochastic=True), folder / "policy")
    assert main(["export", str(folder), "--to", "fmi"]) == 0
    unit = folder / "driver.fmu"
    assert validation.validate_fmu(str(unit)) == []
    first, again, other = (make(unit, seed).speeds(0.1, 5.0) for seed in (1, 1, 2))
    assert first == again
    assert np.abs(np.subtract(first, other)).max() > 1e-3


def test_a_step_that_does_not_go_on_is_an_error(make: Callable[..., Unit]) -> None:
    with pytest.raises(Exception, match="fmi3DoStep"):
        make().advance(0.0)


def test_without_a_compiler_one_sentence_says_so(
    unit: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    assert main(["export", str(unit.parent), "--to", "fmi"]) == 2
    assert "needs a C compiler" in capsys.readouterr().err
