from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cfx.models.base import Follower, Leader
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.trajectory import Start
from cfx_community.models.w74 import W74
from tests.models.test_limits import check_limits
from tests.models.test_regimes import (
    check_that_it_tends_to_the_exact_one,
    check_that_only_smoothing_gives_gradients,
)

L, V = 5.0, 10.0
AX, ABX = L + 2.0, L + 2.0 + 3.5 * V**0.5
SDX = 1.5 * ABX


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def acceleration(
    spacing: float,
    *,
    v: float = V,
    v_l: float = V,
    a: float = 0.0,
    a_l: float = 0.0,
    **parameters: float,
) -> float:
    model = W74()
    p = {p.name: number(parameters.get(p.name, p.default)) for p in model.space}
    follower = Follower(number(0.0), number(v), number(a), torch.zeros(0))
    leader = Leader(number(spacing), number(v_l), number(a_l), number(L))
    return (model.next_speed(follower, leader, p, 0.1).item() - v) / 0.1


def sdv(spacing: float, cx: float = 50.0) -> float:
    return ((spacing - AX) / cx) ** 2


def test_following_keeps_the_sign_of_the_last_acceleration() -> None:
    between = 0.5 * (ABX + SDX)
    assert acceleration(between, a=0.1) == pytest.approx(0.25)
    assert acceleration(between, a=-0.1) == pytest.approx(-0.25)
    assert acceleration(between, a=0.0) == pytest.approx(-0.25)


@pytest.mark.parametrize("spacing", [ABX + 1.0, 0.5 * (ABX + SDX), SDX + 20.0])
def test_closing_in_is_noticed_above_sdv_and_braked_for_to_reach_abx(spacing: float) -> None:
    # SDV is positive when the follower is the faster one: dv = v_l - v is negative there.
    noticed = sdv(spacing) * 1.01
    braking = acceleration(spacing, v_l=V, v=V + noticed)
    assert braking == pytest.approx(-0.5 * noticed**2 / (spacing - ABX))
    assert acceleration(spacing, v_l=V, v=V + 0.99 * sdv(spacing), a=0.1) > 0


def test_a_braking_leader_is_braked_for_when_approaching() -> None:
    spacing = ABX + 5.0
    assert acceleration(spacing, v=V + 2, a_l=-3.0) - acceleration(
        spacing, v=V + 2
    ) == pytest.approx(-3.0)


def test_opening_is_noticed_below_opdv() -> None:
    spacing = 0.5 * (ABX + SDX)
    free = 2.6 * (1 - V / 33.3)
    v_l = V + 1.5 * sdv(spacing) + 1e-6  # min(v, v_l) = v: the thresholds stay
    assert acceleration(spacing, v_l=v_l, a=-1.0) == pytest.approx(free)
    assert acceleration(spacing, v_l=V + 1.4 * sdv(spacing), a=-1.0) == pytest.approx(-0.25)


def test_beyond_sdx_it_drives_freely_towards_the_desired_speed() -> None:
    assert acceleration(SDX + 0.1) == pytest.approx(2.6 * (1 - V / 33.3))
    assert acceleration(500.0, v=33.3, v_l=33.3) == pytest.approx(0.0, abs=1e-9)
    assert acceleration(500.0, v=40.0, v_l=40.0) < 0


def test_below_abx_it_brakes_in_proportion_to_what_is_lacking() -> None:
    half = 0.5 * (AX + ABX)
    assert acceleration(half) == pytest.approx(-4.5)
    assert acceleration(half, v=V, v_l=V + 0.5) > -9.0
    assert acceleration(AX - 0.5) == pytest.approx(-9.0)
    assert acceleration(ABX - 0.01, a_l=5.0) == 0.0  # an emergency never accelerates


def test_behind_a_steady_leader_it_swings_between_the_thresholds() -> None:
    time = torch.arange(3500, dtype=torch.float64) * 0.1
    leader = Leader(V * time, torch.full_like(time, V), torch.zeros_like(time), number(L))
    out = simulate_follower(
        W74(), None, leader, Start(number(-80.0), number(15.0), number(0.0)), 0.1
    )
    spacing = (out.gap + L)[1500:]
    assert spacing.min() > ABX - 0.5
    assert spacing.max() < SDX + 0.5
    assert (out.speed[1500:] - V).abs().max() < 1.0
    assert out.speed[1500:].std() > 0  # unconscious following never settles


def test_the_smoothed_model_tends_to_the_exact_one() -> None:
    check_that_it_tends_to_the_exact_one(W74())


def test_thresholds_have_a_gradient_only_in_the_smoothed_model() -> None:
    check_that_only_smoothing_gives_gradients(W74(), ("bx_add", "sdx_mult", "cx"))


@given(seed=st.integers(0, 1000))
def test_any_parameters_at_any_moment_keep_to_the_limits(seed: int) -> None:
    check_limits(W74(), seed)
