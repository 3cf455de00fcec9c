"""`krauss` and `w99` drive exactly as SUMO's KraussOrig1 and W99 do, wherever SUMO draws no random number."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.models.base import DrivingModel, Leader
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import Start, Trajectory, simulate

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None, reason="SUMO is not here; pip install 'cfx-driving[sumo]'"
)

DT = 0.1
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """One follower behind one leader; the leader's positions are Euler sums of its speeds, as SUMO replays them."""

    leader_speed: Array
    leader_acceleration: float
    leader_length: float
    gap: float
    speed: float
    acceleration: float
    parameters: Mapping[str, float]


def sumo(name: str, drives: list[Drive], attributes: Mapping[str, str]) -> list[dict[str, list[float]]]:
    """Runs the drives in SUMO and returns its trajectories; `attributes` says what SUMO calls each parameter."""
    runs = [
        {
            "model": name,
            "parameters": {attributes[key]: value for key, value in drive.parameters.items() if key in attributes},
            "leader_speed": drive.leader_speed.tolist(),
            "leader_position": 200.0,
            "leader_acceleration": drive.leader_acceleration,
            "leader_length": drive.leader_length,
            "position": 200.0 - drive.leader_length - drive.gap,
            "speed": drive.speed,
            "acceleration": drive.acceleration,
        }
        for drive in drives
    ]
    script = Path(__file__).with_name("sumo_reference.py")
    done = subprocess.run(
        [sys.executable, str(script)], input=json.dumps({"dt": DT, "runs": runs}), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["runs"]  # type: ignore[no-any-return]  # our own script's answer


def ours(model: DrivingModel, cases: list[Drive], reference: list[dict[str, list[float]]]) -> tuple[Trajectory, Leader]:
    """Drives our model behind the leaders whom SUMO drove, at the very same positions; all at once, `(drives, time)`."""
    frames = max(len(drive.leader_speed) for drive in cases)

    def longest(rows: Iterable[Iterable[float]]) -> Tensor:
        return torch.tensor([[*row, *[math.nan] * frames][:frames] for row in rows], dtype=torch.float64)

    def column(values: Iterable[float]) -> Tensor:
        return torch.tensor(list(values), dtype=torch.float64)

    speed = longest(drive.leader_speed for drive in cases)
    first = column(drive.leader_acceleration for drive in cases)[:, None]
    leader = Leader(
        longest(run["leader_position"] for run in reference),
        speed,
        torch.cat([first, speed.diff(dim=1) / DT], dim=1),
        column(drive.leader_length for drive in cases),
    )
    start = Start(
        column(run["position"][0] for run in reference),
        column(drive.speed for drive in cases),
        column(d.acceleration for d in cases),
    )
    parameters = {name: column(drive.parameters[name] for drive in cases) for name in cases[0].parameters}
    with torch.no_grad():
        return simulate(model, parameters, leader, start, DT), leader


def undrawn(drive: Trajectory, leader: Leader) -> Tensor:
    """Frames up to which W99 in SUMO draws no random number that matters: while closing in on a leader with a_l >= 1 it does."""
    draws = (drive.speed > leader.speed) & (leader.acceleration >= 1.0 - 1e-9)
    return (draws.cumsum(dim=1) - draws.long()) == 0


def synthetic(rng: np.random.Generator, count: int, gentle: float) -> Iterable[Array]:
    """Leaders that cruise, brake to a full standstill, wait and drive off, with accelerations up to `gentle`."""
    for _ in range(count):
        frames, speed = 500, float(rng.uniform(2, 25))
        v = [speed]
        target, rate = speed, 1.0
        while len(v) < frames:
            if rng.random() < 0.02:
                target = float(rng.choice([0.0, rng.uniform(0, 25)]))
                rate = float(rng.uniform(0.3, 4.0))
            step = np.clip(target - v[-1], -rate * DT, min(rate, gentle) * DT)
            v.append(max(0.0, v[-1] + float(step)))
        yield np.array(v)


def drives(leaders: Iterable[Array], parameters: Iterable[Mapping[str, float]], rng: np.random.Generator) -> list[Drive]:
    made = []
    for speed, p in zip(leaders, parameters, strict=True):
        v = min(max(0.0, speed[0] + float(rng.uniform(-2, 2))), p["v_max"])
        gap = float(rng.uniform(5, 20) + 1.5 * v)
        made.append(
            Drive(speed, float(rng.uniform(-0.9, 0.9)), float(rng.uniform(3.5, 12)), gap, v, float(rng.uniform(-1, 1)), p)
        )
    return made


@pytest.fixture(scope="module")
def real_leaders(shared_data: Path) -> list[Array]:
    """The speeds of 40 recorded leaders, by position so that a replay is exact."""
    table = pd.read_parquet(shared_data / "i80_reconstructed_pairs.parquet", columns=["pair_id", "leader_position_m"])
    groups = list(table.groupby("pair_id")["leader_position_m"])[::5][:40]
    speeds = [np.clip(np.diff(position.to_numpy()) / DT, 0, None) for _, position in groups]
    return [speed[:700] for speed in speeds]


KRAUSS = {"t_r": "tau", "a": "accel", "b": "decel", "v_max": "maxSpeed", "min_gap": "minGap", "b_max": "emergencyDecel"}
W99_NAMES = {"cc0": "minGap", "b": "decel", "b_max": "emergencyDecel", "v_max": "maxSpeed"} | {
    f"cc{i}": f"cc{i}" for i in range(1, 10)
}


def krauss_parameters(rng: np.random.Generator, count: int) -> list[dict[str, float]]:
    rows = [{"t_r": 1.0, "t_i": 0.0, "a": 2.6, "b": 4.5, "v_max": 55.0, "min_gap": gap, "b_max": 9.0} for gap in (0.0, 2.5)]
    while len(rows) < count:
        b = float(rng.uniform(1.5, 7))
        rows.append(
            {
                "t_r": float(rng.uniform(0.3, 4)),
                "t_i": 0.0,
                "a": float(rng.uniform(0.5, 5)),
                "b": b,
                "v_max": float(rng.uniform(10, 55)),
                "min_gap": float(rng.choice([0.0, 2.5, rng.uniform(0, 5)])),
                "b_max": b + float(rng.uniform(0, 6)),
            }
        )
    return rows


def w99_parameters(rng: np.random.Generator, count: int) -> list[dict[str, float]]:
    space = W99().space
    fixed = {"b": 4.5, "b_max": 9.0, "v_max": 55.0}
    rows = [{p.name: p.default for p in space}]
    while len(rows) < count:
        rows.append({p.name: float(rng.uniform(p.low, p.high)) for p in space.tuned} | fixed)
    return rows


def check(model: DrivingModel, name: str, cases: list[Drive], attributes: Mapping[str, str], *, random: bool) -> float:
    """Compares free rollouts and returns the share of frames that could be compared."""
    reference = sumo(name, cases, attributes)
    mine, leader = ours(model, cases, reference)
    there = leader.position.isfinite()
    counted = there & (mine.collided.cumsum(dim=1) == 0)  # SUMO's vehicles lose a leader whom they have overtaken
    if random:
        counted &= undrawn(mine, leader)
    for drive, own, run, valid in zip(cases, mine.speed, reference, counted, strict=True):
        difference = (own[: len(run["speed"])] - torch.tensor(run["speed"], dtype=torch.float64)).abs()
        difference = difference[valid[: len(difference)]]
        first = int((difference > 1e-9).long().argmax())
        assert difference.max() < 1e-9, f"{drive.parameters} differs from SUMO at frame {first} of {len(difference)}"
    return (counted.sum() / there.sum()).item()


def test_krauss_behind_real_leaders(real_leaders: list[Array]) -> None:
    rng = np.random.default_rng(1)
    cases = drives(real_leaders, krauss_parameters(rng, len(real_leaders)), rng)
    assert check(Krauss(variant="sumo"), "KraussOrig1", cases, KRAUSS, random=False) > 0.9


def test_krauss_behind_leaders_that_stop_and_go() -> None:
    rng = np.random.default_rng(2)
    cases = drives(synthetic(rng, 60, gentle=3.0), krauss_parameters(rng, 60), rng)
    assert check(Krauss(variant="sumo"), "KraussOrig1", cases, KRAUSS, random=False) > 0.9


def test_w99_behind_real_leaders(real_leaders: list[Array]) -> None:
    rng = np.random.default_rng(3)
    cases = drives(real_leaders, w99_parameters(rng, len(real_leaders)), rng)
    assert check(W99(), "W99", cases, W99_NAMES, random=True) > 0.5


def test_w99_behind_leaders_that_stop_and_go() -> None:
    # Leaders that accelerate by less than 1 m/s2: SUMO draws nothing that matters, so whole drives are compared.
    rng = np.random.default_rng(4)
    cases = drives(synthetic(rng, 60, gentle=0.95), w99_parameters(rng, 60), rng)
    assert check(W99(), "W99", cases, W99_NAMES, random=True) > 0.8


def test_w99_single_steps_from_random_states() -> None:
    # States that a drive seldom visits: nearly touching, overlapping, standing, and every case of the rules.
    rng = np.random.default_rng(5)
    cases = []
    for p in w99_parameters(rng, 1500):
        v_l = float(rng.choice([0.0, rng.uniform(0, 2), rng.uniform(0, 20)]))
        v = float(rng.choice([0.0, rng.uniform(0, 2), max(0.0, v_l + 2 * rng.normal())]))
        gap = float(rng.choice([rng.uniform(-0.5, 3), rng.uniform(0, 1), rng.uniform(0, 60)]))
        later = max(0.0, v_l + float(rng.uniform(-0.3, 0.09)))
        cases.append(Drive(np.array([v_l, later]), float(rng.uniform(-4, 0.9)), 5.0, gap, v, float(rng.uniform(-2, 2)), p))
    reference = sumo("W99", cases, W99_NAMES)
    mine, _ = ours(W99(), cases, reference)
    theirs = torch.tensor([run["speed"][1] for run in reference], dtype=torch.float64)
    torch.testing.assert_close(mine.speed[:, 1], theirs, rtol=0.0, atol=1e-9)
