"""`ovm` and `fvdm`: contract, the papers' functions, string stability, SciPy's solution."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import cfx
from cfx.plugin import DrivingModel, Leader, Start
from cfx.simulation.rollout import simulate_follower
from cfx_community.models.fvdm import FVDM
from cfx_community.models.ovm import OVM
from cfx_contracts import check_contract
from cfx_contracts.models import keeps_its_equilibrium

from .steps import LENGTH, gain, next_speed, number

BOOK = {"v0": 120 / 3.6, "width": 15.0, "beta": 1.5}
DEFAULTS: Mapping[type[DrivingModel], Mapping[str, float]] = {
    OVM: BOOK | {"tau": 0.65},
    FVDM: BOOK | {"tau": 5.0, "lambda": 0.6, "reach": 100.0},
}


def equilibrium_gap(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    shift = torch.tanh(p["beta"])
    return p["width"] * (p["beta"] + torch.atanh((1 + shift) * speed / p["v0"] - shift))


def test_they_keep_their_equilibrium_below_their_desired_speed() -> None:
    keeps_its_equilibrium(OVM(parameters={"v0": {"low": 21.0}}), equilibrium_gap)
    tuned = FVDM(parameters={"v0": {"low": 21.0}, "reach": {"tuned": True}})
    check_contract(tuned, equilibrium=equilibrium_gap)


def test_with_the_papers_units_it_is_bandos_function() -> None:
    # Bando et al. (1995): V(h) = tanh(h - 2) + tanh(2), and dv/dt = a (V - v) with a = 1 / tau.
    v0 = 1 + math.tanh(2)
    for h in (0.5, 1.0, 2.0, 3.5):
        wanted = math.tanh(h - 2) + math.tanh(2)
        found = next_speed(OVM(), gap=h, v=0.3, v_l=0.0, v0=v0, width=1.0, beta=2.0, tau=0.5)
        assert found == pytest.approx(0.3 + 0.1 * 2 * (wanted - 0.3))


def test_fvdm_without_its_term_is_ovm_and_beyond_its_reach_too() -> None:
    state = {"gap": 40.0, "v": 12.0, "v_l": 8.0, "tau": 3.0}
    plain = next_speed(OVM(), **state)
    assert next_speed(FVDM(), **state, **{"lambda": 0.0}) == pytest.approx(plain)
    assert next_speed(FVDM(), **state, reach=39.0) == pytest.approx(plain)
    assert next_speed(FVDM(), **state, **{"lambda": 0.6}) == pytest.approx(
        plain + 0.1 * 0.6 * (8.0 - 12.0)
    )


def slope(gap: float, p: Mapping[str, float]) -> float:
    """Returns V'(s), 1/s."""
    return (
        p["v0"]
        / p["width"]
        / math.cosh(gap / p["width"] - p["beta"]) ** 2
        / (1 + math.tanh(p["beta"]))
    )


def velocity(gap: float, p: Mapping[str, float]) -> float:
    return (
        p["v0"]
        * (math.tanh(gap / p["width"] - p["beta"]) + math.tanh(p["beta"]))
        / (1 + math.tanh(p["beta"]))
    )


CASES = {  # gap, m; tau, s; lambda, 1/s
    OVM: ((22.5, 0.65, 0.0), (22.5, 0.3, 0.0), (40.0, 0.65, 0.0), (15.0, 0.5, 0.0)),
    FVDM: (
        (22.5, 0.65, 0.2),
        (22.5, 0.65, 0.5),
        (40.0, 0.65, 0.4),
        (15.0, 5.0, 1.2),
        (15.0, 2.0, 0.5),
    ),
}


@pytest.mark.parametrize("model", [OVM(), FVDM()], ids=["ovm", "fvdm"])
def test_swings_grow_exactly_where_the_linear_theory_says(model: DrivingModel) -> None:
    # Linearised: x'' = (V' (x_l - x) - x') / tau + lambda (x_l' - x'); long waves grow unless
    # V' <= 1 / (2 tau) + lambda.
    pace, cases = 0.15, CASES[type(model)]
    theory, stable = [], []
    for gap, tau, sensitivity in cases:
        steep = slope(gap, BOOK)
        theory.append(
            abs(
                (steep / tau + 1j * pace * sensitivity)
                / (steep / tau - pace**2 + 1j * pace * (1 / tau + sensitivity))
            )
        )
        stable.append(steep <= 1 / (2 * tau) + sensitivity)
    assert set(stable) == {True, False}, "cases on both sides of the limit"
    assert [value <= 1 for value in theory] == stable
    gaps, taus, sensitivities = (
        torch.tensor(column, dtype=torch.float64) for column in zip(*cases, strict=True)
    )
    p = {name: number(value) for name, value in DEFAULTS[type(model)].items()} | {"tau": taus}
    if isinstance(model, FVDM):
        p["lambda"] = sensitivities
    speed = torch.tensor([velocity(gap, BOOK) for gap, _, _ in cases], dtype=torch.float64)
    assert gain(model, p, gap=gaps, speed=speed, pace=pace).tolist() == pytest.approx(
        theory, rel=4e-3
    )


@pytest.mark.parametrize("model", [OVM(limits=None), FVDM(limits=None)], ids=["ovm", "fvdm"])
def test_steps_converge_to_the_differential_equation_with_order_one(model: DrivingModel) -> None:
    p, mean, swing, pace, end, gap, speed = (
        {**DEFAULTS[type(model)]},
        12.0,
        3.0,
        0.25,
        30.0,
        30.0,
        10.0,
    )

    def ahead(t: np.ndarray | float) -> tuple[np.ndarray | float, np.ndarray | float]:
        return mean * t + swing / pace * (1 - np.cos(pace * t)), mean + swing * np.sin(pace * t)

    def motion(t: float, state: np.ndarray) -> tuple[float, float]:
        x_l, v_l = ahead(t)
        s, v = x_l - LENGTH - state[0], state[1]
        return v, (velocity(s, p) - v) / p["tau"] + (
            p.get("lambda", 0.0) * (v_l - v) if s <= 100 else 0.0
        )

    errors = []
    for dt in (0.1, 0.05, 0.025):
        t = np.arange(round(end / dt) + 1) * dt
        exact = solve_ivp(
            motion,
            (0, end),
            (-LENGTH - gap, speed),
            method="DOP853",
            t_eval=t,
            rtol=1e-10,
            atol=1e-10,
        ).y[1]
        leader = Leader(
            *(torch.from_numpy(row)[None] for row in (*ahead(t), 0 * t)), number(LENGTH)[None]
        )
        start = Start(number(-LENGTH - gap)[None], number(speed)[None], number(0.0)[None])
        mine = (
            simulate_follower(
                model, {name: number(value) for name, value in p.items()}, leader, start, dt
            )
            .speed[0]
            .numpy()
        )
        errors.append(np.abs(mine - exact).max())
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(1.0, abs=0.15), errors


def test_a_job_runs_with_the_preset_for_city_traffic(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    overrides = [
        "model=ovm_city",
        "data.pairs=2",
        "data.frames=200",
        "optimizer=random",
        "optimizer.samples=64",
        "calibration.prior=weak",
    ]
    overrides += ["protocol=within_driver", "data=synthetic"]
    result = cfx.run([*overrides, "policy=fixed", "tracking.enabled=false", "figures=none"])
    assert math.isfinite(result.metrics["rmse_speed/driver_specific"])
