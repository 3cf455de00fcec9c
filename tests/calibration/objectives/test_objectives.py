"""The shipped objectives: the contract, and each against a formula written in NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.calibration.huber import SpeedHuber
from cfx.calibration.mixed import Mixed
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.calibration.theil_u import TheilInequality
from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.errors import ConfigError
from cfx.plugin import FrameValues, Objective
from cfx_contracts import check_contract

SHIPPED = {
    "speed_rmse": SpeedRmse(),
    "gap_rmse": GapRmse(),
    "mixed": Mixed(),
    "mixed, speed alone": Mixed(gap_weight=0.0),
    "theil_u": TheilInequality(),
    "theil_u of gaps": TheilInequality(signal="gap"),
    "speed_huber": SpeedHuber(delta=0.5),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_contract(name: str) -> None:
    check_contract(SHIPPED[name])


def test_every_registered_objective_of_cfx_is_tested_here() -> None:
    tested = {type(objective) for objective in SHIPPED.values()}
    own = [one for one in registry.entries("objective") if one.distribution == OWN]
    assert {registry.get("objective", one.name) for one in own} == tested


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def huber(errors: np.ndarray, delta: float) -> float:
    small = np.abs(errors) <= delta
    return float(np.sqrt(np.mean(np.where(small, errors**2, delta * (2 * np.abs(errors) - delta)))))


FORMULAS: dict[str, Any] = {
    "speed_rmse": lambda v, s, w, h: rms(v - w),
    "gap_rmse": lambda v, s, w, h: rms(s - h),
    "mixed": lambda v, s, w, h: rms(v - w) / max(rms(w), 1) + rms(s - h) / max(rms(h), 1),
    "theil_u": lambda v, s, w, h: rms(v - w) / (rms(v) + rms(w)),
    "theil_u of gaps": lambda v, s, w, h: rms(s - h) / (rms(s) + rms(h)),
    "speed_huber": lambda v, s, w, h: huber(v - w, 0.5),
}


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), frames=st.integers(1, 40), size=st.floats(0.01, 30.0))
def test_each_is_its_formula(seed: int, frames: int, size: float) -> None:
    draw = np.random.default_rng(seed)
    signals = size * draw.random((4, frames))
    values = FrameValues(*torch.from_numpy(signals), dt=0.1)
    for name, formula in FORMULAS.items():
        loss = SHIPPED[name](values, torch.ones(frames, dtype=torch.float64))
        assert loss.item() == pytest.approx(formula(*signals), rel=1e-9), name


def test_theils_u_lies_between_0_and_1() -> None:
    one, zero = torch.ones(5, dtype=torch.float64), torch.zeros(5, dtype=torch.float64)
    counted = torch.ones(5)
    assert TheilInequality()(FrameValues(one, one, zero, one, 0.1), counted) == 1.0
    assert TheilInequality()(FrameValues(one, one, one, zero, 0.1), counted) == 0.0
    assert TheilInequality()(FrameValues(zero, one, zero, zero, 0.1), counted) == 0.0


def test_nothing_that_counts_is_no_loss() -> None:
    one = torch.ones((5, 2))
    for objective in SHIPPED.values():
        loss = objective(FrameValues(one, one, one + 1, one + 1, 0.1), torch.zeros(5, 1))
        assert loss.tolist() == [0.0, 0.0]


def test_a_large_error_weighs_less_in_huber() -> None:
    measured = torch.zeros(10, dtype=torch.float64)
    speed = measured.clone()
    speed[0] = 10.0
    frames = FrameValues(speed, speed, measured, measured, 0.1)
    counted = torch.ones(10)
    assert SpeedHuber()(frames, counted) == pytest.approx(math.sqrt(19 / 10))
    assert SpeedRmse()(frames, counted) == pytest.approx(math.sqrt(100 / 10))


def test_mixed_needs_a_weight() -> None:
    with pytest.raises(ConfigError, match=r"leave nothing to minimise"):
        Mixed(speed_weight=0.0, gap_weight=0.0)


def test_an_objective_that_is_accumulated_in_a_compiled_step_has_one_graph() -> None:
    """A rollout may take the terms of each frame inside its compiled step."""
    frame = FrameValues(*torch.rand(4, 3, generator=torch.Generator().manual_seed(0)), dt=0.1)
    for objective in SHIPPED.values():

        def loss(*signals: torch.Tensor, objective: Objective = objective) -> torch.Tensor:
            sums = objective.terms(FrameValues(*signals, dt=0.1))
            return objective.finish(sums, torch.ones(3))

        compiled = torch.compile(loss, backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(*frame[:4]), loss(*frame[:4]))
