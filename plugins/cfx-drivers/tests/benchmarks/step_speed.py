"""What a step of a driver takes outside of SUMO: the column of speeds of docs/where.md.

    python -m plugins.cfx-drivers.tests.benchmarks.step_speed cfx://idm PAIRS.parquet

Processor time of one thread, the least of nine runs, as other work on the machine only adds. PAIRS
is a recording for Gymnasium's environments; the policy's units are made in a temporary folder.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import fmpy
import gymnasium
import numpy as np
import onnxruntime
import torch
from fmpy import fmi3
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

import cfx
import cfx_drivers.gym
from cfx.app.cli import main as cfx_command
from cfx.plugin import DriverStep, Motion
from cfx_drivers.gym.highway import CfxVehicle

RUNS, ENVIRONMENTS = 9, 1024


def least(act: Callable[[], object], steps: int) -> float:
    """Returns the processor time of one of `steps` calls, s."""
    took = []
    for _ in range(RUNS):
        began = time.process_time()
        for _ in range(steps):
            act()
        took.append(time.process_time() - began)
    return min(took) / steps


def in_python(policy: str, drivers: int) -> float:
    """Returns what `DriverStep` takes for so many drivers."""
    step = DriverStep(cfx.load(policy).policy)
    state = step.begin(drivers)
    still = torch.zeros(drivers, dtype=torch.float64)
    ego, leader = Motion(still + 15.0, still), Motion(still + 15.0, still)

    def act() -> None:
        nonlocal state
        _, state = step(state, ego, leader, still + 30.0)

    return least(act, 100)


def in_onnx(file: Path, drivers: int) -> float:
    """Returns what ONNX Runtime takes for so many drivers."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options)
    inputs = {}
    kinds = {"tensor(int64)": np.int64, "tensor(float)": np.float32}
    for signal in session.get_inputs():
        kind = kinds.get(signal.type, np.float64)
        inputs[signal.name] = np.zeros((drivers, *signal.shape[1:]), kind)
    for name, value in (("ego_speed", 15.0), ("leader_speed", 15.0), ("gap", 30.0)):
        inputs[name][:] = value
    return least(lambda: session.run(None, inputs), 100)


def in_fmi(file: Path, folder: Path) -> float:
    """Returns what a step of the FMU takes, called through FMPy."""
    description = fmpy.read_model_description(str(file))
    place = fmpy.extract(str(file), str(folder))
    unit = fmi3.FMU3Slave(
        guid=description.guid,
        unzipDirectory=place,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="driver",
    )
    unit.instantiate()
    numbers = {signal.name: signal.valueReference for signal in description.modelVariables}
    unit.enterInitializationMode()
    signals = [numbers[name] for name in ("ego_speed", "leader_speed", "gap")]
    unit.setFloat64(signals, [15.0, 15.0, 30.0])
    unit.exitInitializationMode()
    now = 0.0

    def act() -> None:
        nonlocal now
        unit.doStep(now, 0.1)
        now += 0.1

    took = least(act, 500)
    unit.terminate()
    unit.freeInstance()
    return took


def in_gymnasium(recording: Path, driver: str | None) -> float:
    """Returns what a step of one of `ENVIRONMENTS` environments takes; a driver follows the ego."""
    gymnasium.register_envs(cfx_drivers.gym)
    environments = gymnasium.make_vec(
        "cfx/CarFollowing-v0",
        num_envs=ENVIRONMENTS,
        recording=str(recording),
        driver=driver,
        followers=int(driver is not None),
    )
    environments.reset(seed=0)
    still = np.zeros(environments.action_space.shape, np.float32)
    return least(lambda: environments.step(still), 20) / ENVIRONMENTS


def in_highway(vehicles: int) -> float:
    """Returns what a step of one vehicle takes in highway-env."""
    road = Road(
        RoadNetwork.straight_road_network(1, speed_limit=40), np_random=np.random.RandomState(0)
    )
    road.vehicles = [Vehicle(road, [5000.0, 0.0], speed=12.0)]
    for number in range(1, vehicles + 1):
        place = [5000.0 - 25.0 * number, 0.0]
        road.vehicles.append(CfxVehicle(road, place, speed=12.0, target_speed=30.0))

    def act() -> None:
        road.act()
        road.step(0.1)

    return least(act, 10) / vehicles


def main() -> None:
    """Prints a line for each tool."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy")
    parser.add_argument("recording", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for drivers in (1, 1000):
        took = in_python(arguments.policy, drivers)
        print(f"DriverStep, {drivers}: {1e3 * took:.3f} ms", flush=True)
    with tempfile.TemporaryDirectory(prefix="cfx-") as name:
        onnx, fmu = Path(name) / "driver.onnx", Path(name) / "driver.fmu"
        for kind, file in (("onnx", onnx), ("fmi", fmu)):
            words = ["export", arguments.policy, "--to", kind, "--output", str(file)]
            if cfx_command(words):
                raise SystemExit(f"cfx {' '.join(words)} failed")
        for drivers in (1, 100, 1000):
            print(f"ONNX, {drivers}: {1e3 * in_onnx(onnx, drivers):.3f} ms", flush=True)
        print(f"FMI: {1e3 * in_fmi(fmu, Path(name) / 'unit'):.4f} ms", flush=True)
    for driver in (None, arguments.policy):
        took = in_gymnasium(arguments.recording, driver)
        print(f"Gymnasium, behind the ego {driver}: {1 / took:,.0f} steps/s", flush=True)
    print(f"highway-env: {1e3 * in_highway(10):.3f} ms a vehicle and step", flush=True)


if __name__ == "__main__":
    main()
