"""`gipps`: the contract, the paper's formulas, its steady states, and its own time step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor

from cfx.plugin import Leader, Start
from cfx.simulation.rollout import simulate_follower
from cfx_community.models.gipps import Gipps
from cfx_contracts.models import keeps_its_equilibrium

from .steps import next_speed, number

TAU = 2 / 3


def test_it_keeps_its_equilibrium_below_its_desired_speed() -> None:
    def gap(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
        return p["s0"] + 1.5 * speed * p["tau"] + speed**2 * (1 / p["b"] - 1 / p["b_hat"]) / 2

    keeps_its_equilibrium(Gipps(parameters={"V": {"low": 21.0, "default": 25.0}}), gap)


def papers_step(gap: float, v: float, v_l: float) -> float:
    """Gipps (1981), equation 12, with its signs: b and b_hat negative."""
    a, b, top, b_hat, s0 = 1.7, -3.4, 20.0, -3.2, 2.0
    free = v + 2.5 * a * TAU * (1 - v / top) * math.sqrt(0.025 + v / top)
    safe = b * TAU + math.sqrt(b * b * TAU * TAU - b * (2 * (gap - s0) - v * TAU - v_l**2 / b_hat))
    return min(free, safe)


@pytest.mark.parametrize(
    ("gap", "v", "v_l"), [(100.0, 5.0, 5.0), (100.0, 0.0, 0.0), (15.0, 12.0, 10.0), (8.0, 9.0, 9.0)]
)
def test_a_step_of_tau_is_the_papers(gap: float, v: float, v_l: float) -> None:
    assert next_speed(Gipps(), gap=gap, v=v, v_l=v_l, dt=TAU) == pytest.approx(
        papers_step(gap, v, v_l)
    )
    # A shorter step goes its share of the way.
    share = 0.1 / TAU
    assert next_speed(Gipps(), gap=gap, v=v, v_l=v_l) == pytest.approx(
        v + share * (papers_step(gap, v, v_l) - v)
    )
    # A longer one stops there.
    assert next_speed(Gipps(), gap=gap, v=v, v_l=v_l, dt=1.0) == pytest.approx(
        papers_step(gap, v, v_l)
    )


@pytest.mark.parametrize(
    ("v", "v_l", "gap"), [(10.0, 0.0, 60.0), (15.0, 12.0, 30.0), (5.0, 5.0, 10.0)]
)
def test_the_safe_speed_is_the_root_of_the_papers_condition(
    v: float, v_l: float, gap: float
) -> None:
    # The paper's condition: stopped by b after tau and tau / 2 more, the driver stands s0 behind
    # the leader, who braked by b_hat.
    def clearance(speed: float) -> float:
        own = (v + speed) * TAU / 2 + speed * TAU / 2 + speed**2 / (2 * 3.4)
        return gap + v_l**2 / (2 * 3.2) - own - 2.0

    safe = brentq(clearance, -5.0, 100.0)
    assert next_speed(Gipps(), gap=gap, v=v, v_l=v_l, dt=TAU, a=1e3, V=70.0) == pytest.approx(safe)


def test_the_greatest_acceleration_on_a_free_road_is_about_a() -> None:
    # 2.5 (1 - r) sqrt(0.025 + r) peaks at r = (1 - 2 * 0.025) / 3 with 0.996: the constants make
    # `a` the greatest acceleration.
    found = max(
        (next_speed(Gipps(), gap=1e6, v=v / 10, v_l=20.0) - v / 10) / 0.1 for v in range(200)
    )
    ratio = (1 - 2 * 0.025) / 3
    assert found == pytest.approx(1.7 * 2.5 * (1 - ratio) * math.sqrt(0.025 + ratio), rel=1e-3)


def test_a_follower_settles_at_the_closed_form_of_the_gap() -> None:
    frames = 2000
    t = torch.arange(frames, dtype=torch.float64) * 0.1
    leader = Leader(
        12.0 * t[None],
        torch.full((1, frames), 12.0).double(),
        torch.zeros(1, frames).double(),
        number(5.0)[None],
    )
    out = simulate_follower(
        Gipps(), None, leader, Start(number(-60.0)[None], number(5.0)[None], number(0.0)[None]), 0.1
    )
    assert out.speed[0, -1].item() == pytest.approx(12.0, abs=1e-6)
    assert out.gap[0, -1].item() == pytest.approx(
        2.0 + 1.5 * 12.0 * TAU + 144.0 * (1 / 3.4 - 1 / 3.2) / 2, abs=1e-4
    )


def test_without_any_gap_it_brakes_to_a_stop() -> None:
    assert next_speed(Gipps(), gap=-30.0, v=0.2, v_l=0.0) == 0.0
    assert next_speed(Gipps(), gap=-30.0, v=10.0, v_l=0.0) < 10.0 - 3.4 * 0.1
