"""Drives as the examples of cfx-drivers do, from whatever installation runs it.

`python driver_examples.py PLATOON`, PLATOON being cfx-drivers's example, in an empty folder.
"""

import runpy
import sys
import warnings
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import fmpy
import gymnasium
import numpy as np
import pandas as pd
from fmpy.validation import validate_fmu
from gymnasium.utils.env_checker import check_env

import cfx
import cfx_drivers.fmi
import cfx_drivers.gym
import cfx_drivers.onnx
from cfx.app import cli

DRIVER, LENGTH, DT = "cfx://idm", 5.0, 0.1


def platoon(example: str) -> pd.DataFrame:
    """Returns the speeds of a platoon that cfx-drivers's example drives, without cfx."""
    assert cli.main(["export", DRIVER, "--to", "onnx", "--output", "driver.onnx"]) == 0
    assert Path("driver.onnx").stat().st_size < 1_000_000
    sys.argv = [example, "driver.onnx"]
    with redirect_stdout(StringIO()) as printed:
        runpy.run_path(example, run_name="__main__")
    return pd.read_csv(StringIO(printed.getvalue()))


def difference_of_unit(rows: pd.DataFrame) -> float:
    """Returns by how much a unit of FMI drives the first follower otherwise, m/s."""
    assert cli.main(["export", DRIVER, "--to", "fmi", "--output", "driver.fmu"]) == 0
    assert not validate_fmu("driver.fmu")
    leader, ego = rows["speed_0"].to_numpy(), rows["speed_1"].to_numpy()
    # The example's leader says how it is about to accelerate, its followers how they did.
    ahead, before = np.append(np.diff(leader), 0.0) / DT, np.append(0.0, np.diff(ego)) / DT
    moved = pd.DataFrame({"leader": leader, "ego": ego}).iloc[1:].cumsum() * DT
    gap = 30.0 - LENGTH + np.append(0.0, moved["leader"] - moved["ego"])
    signals = {
        "ego_speed": ego,
        "ego_acceleration": before,
        "leader_speed": leader,
        "leader_acceleration": ahead,
        "gap": gap,
    }
    taken = np.rec.fromarrays(
        [DT * np.arange(len(rows)), *(np.asarray(one) for one in signals.values())],
        names=["time", *signals],
    )
    found = fmpy.simulate_fmu(
        "driver.fmu",
        stop_time=DT * (len(rows) - 1),
        step_size=DT,
        output_interval=DT,
        input=taken,
        output=["next_speed"],
    )
    return float(np.abs(found["next_speed"][1:] - ego[1:]).max())


def main() -> None:
    print(
        *(
            Path(one.__file__).parent
            for one in (cfx, cfx_drivers.fmi, cfx_drivers.gym, cfx_drivers.onnx)
        )
    )
    rows = platoon(sys.argv[1])
    print(f"platoon: {len(rows)} steps, speeds {rows['speed_1'].min():.2f} to", end=" ")
    print(f"{rows['speed_1'].max():.2f} m/s; unit apart {difference_of_unit(rows):.1e} m/s")

    gymnasium.register_envs(cfx_drivers.gym)
    env = gymnasium.make("cfx/CarFollowing-v0", driver=DRIVER, followers=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what Gymnasium recommends
        check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    done = False
    while not done:
        _, reward, terminated, truncated, _ = env.step([0.0])
        done = terminated or truncated
    print(f"Gymnasium: the last reward is {reward:.2f}")

    import highway_env

    gymnasium.register_envs(highway_env)
    kind = "cfx_drivers.gym.highway.CfxVehicle"
    config = {"other_vehicles_type": kind, "simulation_frequency": 10, "vehicles_count": 10}
    env = gymnasium.make("highway-v0", config=config)
    env.reset(seed=1)
    for _ in range(10):
        *_, truncated, _ = env.step(1)
    driven = [one for one in env.unwrapped.road.vehicles if type(one).__name__ == "CfxVehicle"]
    assert len(driven) == 10
    print(
        f"highway-env: {len(driven)} vehicles, {min(one.speed for one in driven):.1f} m/s at least"
    )


main()
