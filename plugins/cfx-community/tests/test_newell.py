"""`newell`: the contract, the paper's translated path, and the effect of a shorter step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from cfx.plugin import Leader, Start
from cfx.simulation.rollout import simulate_follower
from cfx_community.models.newell import Newell
from cfx_contracts.models import keeps_its_equilibrium

from .steps import LENGTH, gain, next_speed, number

TAU, D = 1.4, 2.5


def test_it_keeps_its_equilibrium_below_its_desired_speed() -> None:
    def gap(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
        return p["d"] + speed * p["tau"]

    keeps_its_equilibrium(Newell(parameters={"v_f": {"low": 21.0}}), gap)


def stop_and_go(dt: float, frames: int) -> Leader:
    t = torch.arange(frames, dtype=torch.float64) * dt
    speed = (8.0 + 10.0 * torch.sin(0.2 * t)).clamp(min=0.0)
    position = torch.cat([torch.zeros(1).double(), torch.cumsum(speed[1:] * dt, dim=0)])
    return Leader(position[None], speed[None], torch.zeros_like(speed)[None], number(LENGTH)[None])


def test_with_steps_of_tau_it_is_the_papers_translated_path() -> None:
    leader = stop_and_go(TAU, 60)
    start = Start(number(-LENGTH - D - 8.0 * TAU)[None], number(8.0)[None], number(0.0)[None])
    out = simulate_follower(Newell(), None, leader, start, TAU)
    torch.testing.assert_close(out.position[:, 1:], leader.position[:, :-1] - LENGTH - D)


def test_behind_an_accelerating_leader_the_gap_is_smaller_by_half_a_tau_squared() -> None:
    a, dt = 0.5, 0.01
    t = torch.arange(3_000, dtype=torch.float64) * dt
    leader = Leader(
        (a * t * t / 2)[None], (a * t)[None], torch.full_like(t, a)[None], number(LENGTH)[None]
    )
    out = simulate_follower(
        Newell(),
        None,
        leader,
        Start(number(-LENGTH - D)[None], number(0.0)[None], number(0.0)[None]),
        dt,
    )
    papers = a * (t[-1] - TAU) ** 2 / 2 - LENGTH - D
    assert (out.position[0, -1] - papers).item() == pytest.approx(a * TAU**2 / 2, rel=2e-2)


def test_swings_fade_as_in_a_low_pass() -> None:
    pace, taus = 0.3, (0.5, 1.4, 4.0)
    p = {"tau": torch.tensor(taus).double(), "d": number(D), "v_f": number(40.0)}
    found = gain(
        Newell(), p, gap=D + 10.0 * p["tau"], speed=torch.full((3,), 10.0).double(), pace=pace
    )
    assert found.tolist() == pytest.approx(
        [1 / math.hypot(1.0, pace * tau) for tau in taus], rel=1e-2
    )


def test_on_a_free_road_it_drives_at_v_f_and_without_a_gap_it_stands() -> None:
    assert next_speed(Newell(), gap=500.0, v=3.0, v_l=3.0) == pytest.approx(120 / 3.6)
    assert next_speed(Newell(), gap=1.0, v=3.0, v_l=3.0) == 0.0
    # A step longer than tau does not drive past the end of the path.
    assert next_speed(Newell(), gap=12.5, v=0.0, v_l=0.0, dt=2.0) == pytest.approx(5.0)
