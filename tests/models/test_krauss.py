from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cfx.models.base import Follower, Leader
from cfx.models.krauss import Krauss
from cfx_contracts import check_contract
from cfx_contracts.models import keeps_its_equilibrium


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def next_speed(model: Krauss, *, gap: float, v: float, v_l: float, **parameters: float) -> float:
    p = {p.name: number(parameters.get(p.name, p.default)) for p in model.space}
    follower = Follower(number(-5.0 - gap), number(v), number(0.0), torch.zeros(0))
    leader = Leader(number(0.0), number(v_l), number(0.0), number(5.0))
    return model.next_speed(follower, leader, p, 0.1).item()


def equilibrium_gap(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    return speed * p["t_r"] + p["min_gap"]


def test_contract_of_its_variants() -> None:
    keeps_its_equilibrium(Krauss(), equilibrium_gap)
    sumo = Krauss(variant="sumo", parameters={"min_gap": {"default": 2.5}})
    check_contract(sumo, equilibrium=equilibrium_gap)
    check_contract(Krauss(leader_deceleration=6.0))


@given(v=st.floats(0.1, 40), t_r=st.floats(0.1, 10), t_i=st.floats(0, 2), b=st.floats(1, 9))
def test_at_equal_speeds_the_gap_is_v_times_t_r_whatever_t_i(
    v: float, t_r: float, t_i: float, b: float
) -> None:
    assert next_speed(Krauss(), gap=v * t_r, v=v, v_l=v, t_r=t_r, t_i=t_i, b=b) == pytest.approx(
        v, abs=1e-9
    )


@given(v_l=st.floats(0, 40), gap=st.floats(0, 100), tau=st.floats(0.1, 3), b=st.floats(1, 9))
def test_without_build_up_time_it_is_krauss_1998(
    v_l: float, gap: float, tau: float, b: float
) -> None:
    # Krauss (1998), eq. for v_safe with both stopping at b: v_l^2 / 2b + g = v tau + v^2 / 2b.
    safe = -b * tau + math.sqrt(b * b * tau * tau + v_l * v_l + 2 * b * gap)
    assert next_speed(Krauss(), gap=gap, v=50.0, v_l=v_l, t_r=tau, t_i=0.0, b=b) == pytest.approx(
        safe if safe < 50.26 else 50.26
    )


@given(
    v_l=st.floats(0, 40),
    gap=st.floats(0, 100),
    t_r=st.floats(0.1, 3),
    t_i=st.floats(0, 2),
    b=st.floats(1, 9),
    b_l=st.floats(1, 9),
)
def test_the_safe_speed_stops_within_the_gap_and_the_leaders_stopping_distance(
    v_l: float, gap: float, t_r: float, t_i: float, b: float, b_l: float
) -> None:
    v = next_speed(Krauss(leader_deceleration=b_l), gap=gap, v=54.0, v_l=v_l, t_r=t_r, t_i=t_i, b=b)
    own = v * (t_r + t_i / 2) + v * v / (2 * b)
    leaders = v_l * t_i / 2 + v_l * v_l / (2 * b_l)
    assert own <= gap + leaders + 1e-6


def test_an_overlapping_leader_makes_it_stop() -> None:
    assert next_speed(Krauss(), gap=-30.0, v=10.0, v_l=0.0) == 0.0
    # SUMO itself would get NaN here and ignore the leader; we brake as hard as the brakes go.
    assert next_speed(Krauss(variant="sumo"), gap=-30.0, v=10.0, v_l=0.5) == pytest.approx(
        10.0 - 0.9
    )
