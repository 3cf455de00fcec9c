"""Platoons: what becomes of a leader's braking along ten followers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.data.pairs import PairBatch
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.platoon import (
    LENGTH,
    VEHICLES,
    Manoeuvre,
    measure_platoons,
    simulate_platoons,
    slowing,
)
from cfx.evaluation.result import Platoon
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.krauss import Krauss
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from tests.agents import adaptive as live
from tests.evaluation.test_closed_loop import adaptive, constant
from tests.without_equations import WithoutEquations


class Linear(DrivingModel):
    """a = k_gap (gap - h v) + k_speed (v_l - v).

    Small disturbances of all wavelengths die out along a platoon if k_gap h^2 + 2 k_speed h > 2, to
    be found in textbooks such as Treiber and Kesting (2013), Traffic Flow Dynamics, eq. 15.
    """

    parameters = ParameterSpace.of(
        Parameter("h", "s", 0.1, 3.0, 1.5, "time gap"),
        Parameter("k_gap", "1/s2", 0.0, 2.0, 0.3, "answer to the gap"),
        Parameter("k_speed", "1/s", 0.0, 2.0, 0.6, "answer to the speed difference"),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        gap = bumper_gap(follower, leader)
        answer = p["k_gap"] * (gap - p["h"] * follower.speed) + p["k_speed"] * (
            leader.speed - follower.speed
        )
        return (follower.speed + answer * dt).clamp(min=0.0)


class Anticipating(Linear):
    """As `Linear`, and with half of the leader's acceleration."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        speed = super().next_speed(follower, leader, p, dt)
        return (speed + 0.5 * leader.acceleration * dt).clamp(min=0.0)


STABLE, UNSTABLE = (2.0, 0.5, 0.8), (1.0, 0.4, 0.5)  # 5.2 and 1.4


def measured(model: DrivingModel, *parameters: tuple[float, ...]) -> Platoon:
    values = torch.tensor(parameters).double()
    found = measure_platoons(
        model,
        {"driver_specific": (constant(model, values), [f"set {k}" for k in range(len(values))])},
    )
    assert found is not None
    return found


def test_a_stable_model_is_distinguished_from_an_unstable_one() -> None:
    calm, wild = measured(Linear(), STABLE, UNSTABLE).measures.to_dict("records")
    assert (calm["string_stable"], calm["settled"], calm["collisions"]) == (1, 1, 0)
    assert calm["drop_leader"] == pytest.approx(8.0)
    assert calm["head_to_tail"] < 0.95
    assert (wild["string_stable"], wild["settled"]) == (0, 1)
    assert wild["amplification"] > 1.2
    assert wild["drop_first"] > wild["drop_leader"] + 0.1


def test_the_metrics_summarize_the_platoons_of_a_method() -> None:
    platoon = measured(Linear(), STABLE, UNSTABLE)
    metrics, both = platoon.metrics(), platoon.measures
    assert metrics["platoon/amplification/driver_specific"] == pytest.approx(
        both["amplification"].mean()
    )
    assert metrics["platoon/string_stable/driver_specific"] == 0.5
    assert metrics["platoon/min_gap/driver_specific"] == both["min_gap"].min()
    assert metrics["platoon/collisions/driver_specific"] == both["collisions"].sum()


def test_krauss_settles_at_its_equilibrium_gap() -> None:
    times = (1.0, 1.8, 2.5)
    table = measured(Krauss(), *((t_r, 0.2) for t_r in times)).table
    last = table[(table["vehicle"] > 0) & (np.isclose(table["time_s"], 59.9))]
    for k, t_r in enumerate(times):
        rows = last[last["network"] == f"set {k}"]
        assert len(rows) == VEHICLES
        assert rows["gap"].to_numpy() == pytest.approx(15.0 * t_r, abs=0.3)
        assert rows["speed"].to_numpy() == pytest.approx(15.0, abs=0.1)


def test_a_vehicle_that_follows_too_closely_for_its_brakes_collides_and_is_not_stable() -> None:
    (row,) = measured(Linear(), (0.1, 0.02, 0.0)).measures.to_dict("records")
    assert row["collisions"] > 0
    assert row["min_gap"] < 0
    assert row["string_stable"] == 0
    assert np.isnan(row["amplification"])


def test_who_does_not_follow_amplifies_nothing() -> None:
    (row,) = measured(Linear(), (3.0, 0.0, 0.0)).measures.to_dict("records")
    assert row["drop_first"] == 0
    assert np.isnan(row["amplification"])


@pytest.mark.parametrize("model", [Krauss(), Anticipating()])
def test_each_vehicle_drives_as_it_would_alone_behind_the_one_before(model: DrivingModel) -> None:
    short = Manoeuvre(settle=5, after=5, hold=2)
    policy = adaptive(
        model, GruPolicy(start="middle", inputs=("leader_speed", "follower_speed", "gap")), 2, 15
    )
    ((speed, gap),) = simulate_platoons(model, [policy], short)
    frames = speed.shape[-1]
    for vehicle in (1, 7, VEHICLES):
        ahead, own = speed[vehicle - 1], speed[vehicle]
        position = torch.cat([torch.zeros(2, 1), (ahead[:, 1:] * 0.1).cumsum(1)], dim=1).double()
        acceleration = torch.diff(ahead, dim=1, prepend=ahead[:, :1]) / 0.1
        nothing = torch.full_like(ahead, torch.nan)
        nothing[:, 0] = 0.0
        batch = PairBatch(
            position,
            ahead,
            acceleration,
            nothing + position[:, :1] - LENGTH - gap[vehicle - 1, :, :1],
            nothing + own[:, :1],
            nothing,
            torch.full((2,), LENGTH).double(),
            torch.full((2,), frames),
            torch.ones(2, frames).bool(),
            0.1,
        )
        alone = simulate_closed_loop(
            MemoryStepper(model, 0.1),
            policy,
            Followers(batch, torch.arange(2)),
            torch.zeros(2).long(),
        )
        torch.testing.assert_close(alone.speed, own, atol=1e-5, rtol=0)
        torch.testing.assert_close(alone.gap, gap[vehicle - 1], atol=1e-4, rtol=0)


def test_platoons_of_several_methods_do_not_touch_each_other() -> None:
    model, short = Linear(), Manoeuvre(settle=5, after=5, hold=2)
    one, other = (constant(model, torch.tensor([values]).double()) for values in (STABLE, UNSTABLE))
    together = simulate_platoons(model, [one, other], short)
    for (speed, _), policy in zip(together, (one, other), strict=True):
        ((alone, _),) = simulate_platoons(model, [policy], short)
        assert torch.equal(speed, alone)


def test_an_agent_with_a_residual_drives_its_own_model_beside_others() -> None:
    """Its vehicles start at the common speed without acceleration, whatever the model wants."""
    residual = live({"name": "krauss"}, residual=True)
    model, short = Krauss(), Manoeuvre(settle=5, after=5, hold=2)
    other = constant(model, model.space.defaults()[None])
    agents = {"default": (other, ("any",)), "policy": (residual, ("all",))}
    found = measure_platoons(model, agents, short)
    assert found is not None
    ((speed, _),) = simulate_platoons(model, [residual], short)
    table = found.table[found.table["method"] == "policy"]
    assert table["speed"].to_numpy() == pytest.approx(speed.flatten().numpy(), abs=1e-5)
    assert speed[1:, 0, 1].tolist() == pytest.approx([15.0] * VEHICLES, abs=1e-9)
    assert float((speed[1:, 0, 5] - 15.0).abs().max()) > 1e-3


def test_a_stochastic_agent_draws_from_a_generator_only() -> None:
    stochastic = live({"name": "krauss"}, stochastic=True)
    short = Manoeuvre(settle=2, after=1, hold=1)
    found = {}
    for seed in (0, 1):
        generator = torch.Generator().manual_seed(seed)
        ((found[seed], _),) = simulate_platoons(Krauss(), [stochastic], short, generator)
    ((centre, _),) = simulate_platoons(Krauss(), [stochastic], short)
    assert torch.equal(found[0][0], centre[0]), "the leader"
    assert not torch.equal(found[0], found[1])
    assert not torch.equal(found[0], centre)


def test_what_a_vehicle_overshoots_on_the_way_back_is_no_slowing() -> None:
    speed = torch.tensor(
        [[15.0, 14.0, 9.0, 12.0, 17.0, 15.0], [15.0, 16.0, 14.5, 15.5, 18.0, 15.0]]
    )
    assert slowing(speed).tolist() == [6.0, 1.5]


def test_the_leader_does_what_the_manoeuvre_says() -> None:
    speed = Manoeuvre().speed(0.1)
    assert len(speed) == 1421
    assert set(np.round(np.diff(speed) / 0.1, 6)) == {0.0, -2.0, 1.0}
    assert (speed.max(), speed.min(), speed[600], speed[-1]) == (15.0, 7.0, 15.0, 15.0)


def test_a_model_without_equations_has_no_platoon() -> None:
    assert measure_platoons(WithoutEquations(), {}) is None
