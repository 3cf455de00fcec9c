from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cfx.errors import ConfigError
from cfx.models.base import Follower, Leader
from cfx.models.krauss import Krauss
from cfx.models.vtype import VType
from cfx_contracts import check_contract
from cfx_contracts.models import keeps_its_equilibrium


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def next_speed(
    model: Krauss, *, gap: float, v: float, v_l: float, dt: float = 0.1, **parameters: float
) -> float:
    p = {p.name: number(parameters.get(p.name, p.default)) for p in model.space}
    follower = Follower(number(-5.0 - gap), number(v), number(0.0), torch.zeros(0))
    leader = Leader(number(0.0), number(v_l), number(0.0), number(5.0))
    return model.next_speed(follower, leader, p, dt).item()


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


@pytest.mark.parametrize(
    ("gap", "expected"), [(0.005, 0.0), (1.0, 2.0), (2.0, 2.25), (2.3, 1.3902)]
)
def test_as_in_sumo_it_creeps_up_to_a_leader_that_stands(gap: float, expected: float) -> None:
    """KraussOrig1 takes what is left of the gap in one step, but no more than b dt (2.25 m/s).

    Above a gap of b dt the safe speed is that of any leader: sqrt(b^2 t_r^2 + 2 b g) - b t_r.
    """
    parameters = {"t_r": 1.5, "t_i": 0.0, "b": 4.5}
    speed = next_speed(Krauss(variant="sumo"), gap=gap, v=2.0, v_l=0.0, dt=0.5, **parameters)
    assert speed == pytest.approx(expected, abs=1e-3)


def test_sumo_has_it_without_a_build_up_time_alone() -> None:
    def vtype(default: float, *, tuned: bool, variant: str = "sumo") -> VType:
        changes = {"t_i": {"default": default, "tuned": tuned}}
        model = Krauss(variant=variant, parameters=changes)
        return model.sumo_vtype({p.name: number(p.default) for p in model.space})

    made = vtype(0.0, tuned=False)
    assert made.car_follow_model == "KraussOrig1"
    values = {name: float(value) for name, value in made.attributes.items()}
    assert values["tau"] == pytest.approx(1.5)
    assert values["emergencyDecel"] == pytest.approx(9.0)
    for default, tuned in ((0.1, False), (0.0, True)):
        with pytest.raises(ConfigError, match="only without a brake build-up time"):
            vtype(default, tuned=tuned)
    with pytest.raises(ConfigError, match=r"model\.variant=sumo"):
        vtype(0.0, tuned=False, variant="paper")
