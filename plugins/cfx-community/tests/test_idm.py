"""`idm`: the contract, closed forms, the differential equation by SciPy, and SUMO."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import cfx
from cfx.plugin import Follower, Leader, Start
from cfx.simulation.rollout import simulate_follower
from cfx_community.models.iidm import IIDM
from cfx_contracts import check_contract

from .rollouts import order

IDM: Any = cfx.get("model", "idm")
PAPER = {"v0": 120 / 3.6, "T": 1.6, "s0": 2.0, "a": 0.73, "b": 1.67, "delta": 4.0}


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def acceleration(
    model: cfx.plugin.DrivingModel, *, gap: float, v: float, v_l: float, **changes: float
) -> float:
    """Returns dv/dt as a very short step shows it."""
    p = {name: number(value) for name, value in (PAPER | changes).items()}
    follower = Follower(number(-5.0 - gap), number(v), number(0.0), torch.zeros(0))
    leader = Leader(number(0.0), number(v_l), number(0.0), number(5.0))
    return (model.next_speed(follower, leader, p, 1e-3).item() - v) / 1e-3


def gap_of_idm(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    return (p["s0"] + speed * p["T"]) / torch.sqrt(1.0 - (speed / p["v0"]) ** p["delta"])


def gap_of_iidm(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    return p["s0"] + speed * p["T"]


@pytest.mark.parametrize(("kind", "equilibrium"), [(IDM, gap_of_idm), (IIDM, gap_of_iidm)])
def test_contract_below_the_desired_speed_with_all_parameters_tuned(
    kind: Any, equilibrium: Any
) -> None:
    model = kind(parameters={"v0": {"low": 21.0}, "delta": {"tuned": True}})
    check_contract(model, equilibrium=equilibrium)


def test_the_defaults_are_the_papers() -> None:
    for model in (IDM(), IIDM()):
        assert {p.name: p.default for p in model.space} == pytest.approx(PAPER)
        assert model.space.names == ("v0", "T", "s0", "a", "b")


@pytest.mark.parametrize("model", [IDM(), IIDM()])
def test_limits_that_the_paper_states(model: cfx.plugin.DrivingModel) -> None:
    # From standstill on a free road: a. At v0 on a free road: 0.
    assert acceleration(model, gap=1e6, v=0.0, v_l=0.0) == pytest.approx(0.73, abs=1e-6)
    assert acceleration(model, gap=1e6, v=120 / 3.6, v_l=120 / 3.6) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("needed", [0.5, 1.67, 4.0])
def test_braking_for_a_standing_obstacle_squares_the_deceleration_that_is_needed(
    needed: float,
) -> None:
    # The paper's braking strategy: where v^2 / (2 s) is needed to stop in time, the model brakes
    # by its square over b.
    v = 20.0
    found = acceleration(IDM(), gap=v * v / (2 * needed), v=v, v_l=0.0, T=0.0, s0=0.0, v0=1e6)
    assert found == pytest.approx(0.73 - needed**2 / 1.67)


def test_at_standstill_behind_a_leader_iidm_is_idm() -> None:
    for gap in (1.0, 2.0, 5.0, 50.0):
        assert acceleration(IIDM(), gap=gap, v=0.0, v_l=0.0) == pytest.approx(
            acceleration(IDM(), gap=gap, v=0.0, v_l=0.0)
        )


def test_above_the_desired_speed_iidm_brakes_by_b_at_most_and_idm_by_far_more() -> None:
    for v in (20.0, 30.0, 60.0):
        assert -1.67 <= acceleration(IIDM(), gap=1e6, v=v, v_l=v, v0=15.0) < 0.0
    assert acceleration(IDM(), gap=1e6, v=30.0, v_l=30.0, v0=15.0) == pytest.approx(
        0.73 * (1 - 2**4), rel=1e-3
    )


def test_iidm_is_continuous_where_its_cases_meet() -> None:
    # Around v = v0, and around z = 1 on either side of v0.
    v0, tiny = 15.0, 1e-7
    for gap in (2.0 + 1.6 * v0 - 5.0, 200.0):
        below, above = (
            acceleration(IIDM(), gap=gap, v=v0 + side * tiny, v_l=v0, v0=v0) for side in (-1, 1)
        )
        assert below == pytest.approx(above, abs=1e-5)
    for v in (10.0, 20.0):
        desired = 2.0 + 1.6 * v
        near, far = (
            acceleration(IIDM(), gap=desired + side * tiny, v=v, v_l=v, v0=v0) for side in (-1, 1)
        )
        assert near == pytest.approx(far, abs=1e-5)


def book_idm(s: float, v: float, v_l: float, p: Mapping[str, float]) -> float:
    desired = p["s0"] + max(0.0, v * p["T"] + v * (v - v_l) / (2 * math.sqrt(p["a"] * p["b"])))
    return p["a"] * (1 - (v / p["v0"]) ** p["delta"] - (desired / s) ** 2)


def book_iidm(s: float, v: float, v_l: float, p: Mapping[str, float]) -> float:
    z = (p["s0"] + max(0.0, v * p["T"] + v * (v - v_l) / (2 * math.sqrt(p["a"] * p["b"])))) / s
    if v <= p["v0"]:
        free = p["a"] * (1 - (v / p["v0"]) ** p["delta"])
        if z >= 1:
            return p["a"] * (1 - z * z)
        return free * (1 - z ** (2 * p["a"] / free)) if free > 0 else 0.0
    free = -p["b"] * (1 - (p["v0"] / v) ** (p["a"] * p["delta"] / p["b"]))
    return free + p["a"] * (1 - z * z) if z >= 1 else free


@pytest.mark.parametrize(("model", "book"), [(IDM(), book_idm), (IIDM(), book_iidm)])
@pytest.mark.parametrize("changes", [{}, {"v0": 15.0, "T": 1.0, "a": 1.5}])
def test_steps_converge_to_the_differential_equation_with_order_one(model, book, changes) -> None:
    assert order(model, book, PAPER | changes, gap=30.0, speed=12.0) == pytest.approx(1.0, abs=0.15)


SUMO_NAMES = {
    "v0": "maxSpeed",
    "T": "tau",
    "s0": "minGap",
    "a": "accel",
    "b": "decel",
    "delta": "delta",
}


def random_leader(rng: np.random.Generator, frames: int) -> list[float]:
    """Returns speeds, m/s, of a leader who now and then wants another one, or to stop."""
    speeds = [float(rng.uniform(3, 20))]
    target = speeds[0]
    while len(speeds) < frames:
        if rng.random() < 0.02:
            target = float(rng.choice([0.0, rng.uniform(0, 20)]))
        change = float(np.clip(target - speeds[-1], -0.25, 0.2))
        speeds.append(max(0.0, speeds[-1] + change))
    return speeds


def random_runs(count: int, frames: int) -> list[dict[str, Any]]:
    """Returns runs for `sumo_reference.py`, with the parameters under their own names as `p`."""
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(count):
        leader_speed = random_leader(rng, frames)
        p = {
            "v0": float(rng.uniform(21, 40)),
            "T": float(rng.uniform(0.5, 4)),
            "s0": float(rng.uniform(1, 5)),
            "a": float(rng.uniform(0.4, 4)),
            "b": float(rng.uniform(0.5, 5)),
            "delta": 4.0,
        }
        # SUMO's own brake cap and rounding lie around every model; the cap is lifted here.
        parameters = {"emergencyDecel": 1000.0}
        for name, value in p.items():
            parameters[SUMO_NAMES[name]] = value
        gap = float(rng.uniform(20, 60))
        runs.append(
            {
                "p": p,
                "parameters": parameters,
                "leader_speed": leader_speed,
                "gap": gap,
                "speed": leader_speed[0],
            }
        )
    return runs


def sumos(runs: list[dict[str, Any]]) -> tuple[Tensor, Tensor]:
    """Returns the leaders' positions and the followers' speeds in SUMO, `(runs, frames)` each."""
    script = Path(__file__).with_name("sumo_reference.py")
    done = subprocess.run(
        [sys.executable, str(script)],
        input=json.dumps({"runs": runs}),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answer = torch.tensor(json.loads(done.stdout), dtype=torch.float64)
    return answer[:, 0], answer[:, 2]


@pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-community[test]'",
)
def test_idm_is_sumos() -> None:
    runs = random_runs(40, 400)
    ahead, speed = sumos(runs)
    v_l = torch.tensor([run["leader_speed"] for run in runs], dtype=torch.float64)
    gap = torch.tensor([run["gap"] for run in runs], dtype=torch.float64)
    column = {}
    for name in PAPER:
        values = [run["p"][name] for run in runs]
        column[name] = torch.tensor(values, dtype=torch.float64)
    leader = Leader(ahead, v_l, torch.zeros_like(v_l), torch.full_like(gap, 5.0))
    start = Start(ahead[:, 0] - 5.0 - gap, v_l[:, 0], torch.zeros_like(gap))
    mine = simulate_follower(IDM(limits=None), column, leader, start, 0.1)
    assert not bool(mine.collided.any())
    assert (mine.speed.diff(dim=1) < -0.3).any(), "the leaders must make it brake"
    difference = (mine.speed - speed).abs()
    assert difference.max() < 2e-5, "SUMO rounds speeds below 1e-5 m/s to 0"
    untouched = (mine.speed < 1e-4).cumsum(dim=1) == 0
    assert untouched.double().mean() > 0.5
    assert difference[untouched].max() < 1e-9


def test_a_job_runs_with_the_preset_for_city_traffic(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    overrides = [
        "model=idm_city",
        "protocol=within_driver",
        "data=synthetic",
        "data.pairs=2",
        "data.frames=200",
        "optimizer=random",
        "optimizer.samples=64",
        "calibration.prior=weak",
    ]
    result = cfx.run([*overrides, "policy=fixed", "tracking.enabled=false", "figures=none"])
    assert math.isfinite(result.metrics["rmse_speed/driver_specific"])
