from __future__ import annotations

import pytest
import torch

import cfx
from cfx.models.base import Leader
from cfx.models.direct import Direct
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.trajectory import Start


def drive(acceleration: float, seconds: float, leader_speed: float = 12.0) -> list[float]:
    """Returns the speed each second, from 10 m/s."""
    frames = round(seconds * 10) + 1
    constant = torch.full((1, frames), leader_speed).double()
    leader = Leader(
        30 + constant.cumsum(1) * 0.1,
        constant,
        torch.zeros_like(constant),
        torch.tensor([5.0]).double(),
    )
    zero = torch.zeros(1).double()
    found = simulate_follower(
        Direct(), torch.tensor([[acceleration]]).double(), leader, Start(zero, zero + 10, zero), 0.1
    )
    return [float(v) for v in found.speed[0, ::10]]


def test_it_does_what_it_is_told_and_stops_at_a_standstill() -> None:
    assert drive(1.5, 3) == pytest.approx([10, 11.5, 13, 14.5])
    assert drive(-4.0, 4) == pytest.approx([10, 6, 2, 0, 0])


def test_no_leader_matters_to_it() -> None:
    assert drive(0.5, 10, leader_speed=0.0) == drive(0.5, 10, leader_speed=30.0)


def test_it_is_a_model_like_any_other_and_says_that_its_fixed_parameters_are_no_baseline() -> None:
    assert cfx.get("model", "direct") is Direct
    assert not Direct.has_constant_baseline
    assert Direct().space.names == ("acceleration",)
