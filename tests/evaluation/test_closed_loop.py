from __future__ import annotations

import math
from dataclasses import replace

import pandas as pd
import pytest
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.data.style import StyleResult
from cfx.evaluation.closed_loop import ClosedLoop, Followers, simulate_closed_loop
from cfx.evaluation.evaluate import ComparedPairs, evaluate
from cfx.models.base import DrivingModel, Leader
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.agent import Agent
from cfx.policies.base import Policy
from cfx.policies.constant import ConstantNetwork, FixedPolicy
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler
from cfx.policies.gru import GruPolicy
from cfx.policies.heads.base import DirectHead
from cfx.simulation.rollout import MemoryStepper, simulate_follower
from cfx.simulation.trajectory import Start
from cfx.simulation.windows import WindowSettings
from tests.drives import wavy_pairs

SPEEDS = ("leader_speed", "follower_speed")


def constant(model: DrivingModel, parameters: Tensor) -> Agent:
    unit = model.space.to_unit(parameters)
    count = len(unit)
    scaler = Scaler(torch.zeros((count, 1)).double(), torch.ones((count, 1)).double())
    return Agent(
        AgentCore(FixedPolicy(), ConstantNetwork(unit), scaler, DirectHead(model.space)),
        {"name": "krauss"},
        {"name": "fixed"},
        WindowSettings(),
        0.1,
        tuple(f"p{i}" for i in range(count)),
    )


def adaptive(model: DrivingModel, policy: Policy, networks: int, features: int) -> Agent:
    network = policy.build(
        features,
        model.space.to_unit(model.space.defaults()),
        torch.full((networks, len(model.space)), 0.5),
        torch.Generator().manual_seed(0),
    )
    scaler = Scaler(torch.full((networks, features), 8.0), torch.full((networks, features), 3.0))
    names = tuple(f"p{i}" for i in range(networks))
    return Agent(
        AgentCore(policy, network.eval(), scaler, DirectHead(model.space)),
        {"name": "krauss"},
        {"name": "gru"},
        WindowSettings(),
        0.1,
        names,
    )


@pytest.mark.parametrize("model", [Krauss(), W99()])
def test_true_parameters_drive_exactly_like_the_driver(model: DrivingModel) -> None:
    low, high = model.space.bounds()
    true = model.space.defaults() + 0.1 * (high - low) * torch.linspace(-1, 1, 3).double()[:, None]
    true = true.clamp(low, high)
    pairs = wavy_pairs(model, true)
    batch = PairBatch.of(pairs)
    loop = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        constant(model, true),
        Followers(batch, torch.arange(3)),
        torch.tensor([200, 215, 100]),
    )
    for i, first in enumerate((200, 215, 100)):
        counted = int(loop.counted[i].sum())
        assert counted == 299 - first
        real = torch.as_tensor(pairs[i].follower_speed[first:])
        torch.testing.assert_close(loop.speed[i, : counted + 1], real, atol=1e-9, rtol=0)


def test_constant_parameters_are_the_plain_rollout() -> None:
    model = Krauss()
    parameters = torch.tensor([[2.0, 0.3], [1.0, 0.0]], dtype=torch.float64)
    batch = PairBatch.of(
        wavy_pairs(model, torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64))
    )
    first = torch.tensor([150, 150])
    loop = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        constant(model, parameters),
        Followers(batch, torch.arange(2)),
        first,
    )
    leader = Leader(
        batch.leader_position[:, 150:],
        batch.leader_speed[:, 150:],
        batch.leader_acceleration[:, 150:],
        batch.leader_length,
    )
    start = Start(
        batch.follower_position[:, 150],
        batch.follower_speed[:, 150],
        batch.follower_acceleration[:, 150],
    )
    plain = simulate_follower(model, parameters, leader, start, 0.1)
    torch.testing.assert_close(loop.speed, plain.speed)
    torch.testing.assert_close(loop.gap, plain.gap)
    torch.testing.assert_close(loop.parameters, parameters[:, None].expand_as(loop.parameters))


def closed_loop_of(
    batch: PairBatch, model: DrivingModel, first: Tensor, history: float | None = None
) -> ClosedLoop:
    policy = adaptive(
        model,
        GruPolicy(start="middle", inputs=("leader_speed", "follower_speed", "gap")),
        len(batch),
        15,
    )
    followers = Followers(batch, torch.arange(len(batch)), history=history)
    return simulate_closed_loop(MemoryStepper(model, 0.1), policy, followers, first)


def test_the_policy_never_sees_the_measured_follower_of_the_test_part() -> None:
    model = Krauss()
    batch = PairBatch.of(
        wavy_pairs(model, torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64))
    )
    first = torch.tensor([150, 200])
    before = closed_loop_of(batch, model, first)
    frame = torch.arange(batch.mask.shape[1])
    hidden = frame > first[:, None]
    changed = replace(
        batch,
        **{
            name: torch.where(hidden, 99.0, getattr(batch, name))
            for name in ("follower_position", "follower_speed", "follower_acceleration")
        },
    )
    after = closed_loop_of(changed, model, first)
    torch.testing.assert_close(before, after)


def test_the_policy_observes_the_history_first() -> None:
    model = Krauss()
    batch = PairBatch.of(
        wavy_pairs(model, torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64))
    )
    first = torch.tensor([150, 200])
    before = closed_loop_of(batch, model, first)
    changed = replace(
        batch,
        follower_speed=torch.where(
            torch.arange(300) < 100, batch.follower_speed + 1, batch.follower_speed
        ),
    )
    after = closed_loop_of(changed, model, first)
    assert not torch.equal(before.parameters, after.parameters)


def test_the_policy_observes_so_many_seconds_before_the_test() -> None:
    model = Krauss()
    parameters = torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64)
    batch = PairBatch.of(wavy_pairs(model, parameters))
    first, frame = torch.tensor([150, 200]), torch.arange(batch.mask.shape[1])
    loops = []
    for earlier_than_s in (5.5, 3.0):  # the first window holds half a second before
        is_changed = frame < first[:, None] - round(earlier_than_s / 0.1)
        changed = replace(batch, leader_speed=torch.where(is_changed, 1.0, batch.leader_speed))
        loops.append(closed_loop_of(changed, model, first, history=5.0))
    unchanged = closed_loop_of(batch, model, first, history=5.0)
    assert torch.equal(loops[0].parameters, unchanged.parameters)
    assert not torch.equal(loops[1].parameters, unchanged.parameters)


def test_a_pair_drives_the_same_whatever_drives_beside_it() -> None:
    model = Krauss()
    true = torch.tensor([[1.5, 0.1], [3.0, 0.5], [2.0, 0.0]], dtype=torch.float64)
    batch = PairBatch.of(wavy_pairs(model, true))
    policy = adaptive(model, GruPolicy(start="middle", inputs=SPEEDS), 3, 10)
    together = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        policy,
        Followers(batch, torch.arange(3)),
        torch.tensor([150, 200, 100]),
    )
    alone = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        policy,
        Followers(batch[1:2], torch.tensor([1])),
        torch.tensor([200]),
    )
    steps = alone.speed.shape[1]
    torch.testing.assert_close(together.speed[1:2, :steps], alone.speed, atol=1e-5, rtol=1e-5)


def test_several_drivers_share_one_network() -> None:
    model = Krauss()
    batch = PairBatch.of(
        wavy_pairs(model, torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64))
    )
    shared = adaptive(model, GruPolicy(start="middle", inputs=SPEEDS), 1, 10)
    both = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        shared,
        Followers(batch, torch.tensor([0, 0])),
        torch.tensor([150, 150]),
    )
    second = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        shared,
        Followers(batch[1:2], torch.tensor([0])),
        torch.tensor([150]),
    )
    torch.testing.assert_close(both.parameters[1:2], second.parameters, atol=1e-5, rtol=1e-5)


def test_the_table_says_what_the_loops_did() -> None:
    model = Krauss()
    true = torch.tensor([[1.5, 0.1], [3.0, 0.5]], dtype=torch.float64)
    pairs = wavy_pairs(model, true)
    batch = PairBatch.of(pairs)
    first = torch.tensor([150, 200])
    stepper = MemoryStepper(model, 0.1)
    loops = {
        "default": simulate_closed_loop(
            stepper,
            constant(model, model.space.defaults().expand(2, 2)),
            Followers(batch, torch.arange(2)),
            first,
        ),
        "driver_specific": simulate_closed_loop(
            stepper,
            constant(model, torch.tensor([[4.0, 0.1], [4.0, 0.1]]).double()),
            Followers(batch, torch.arange(2)),
            first,
        ),
        "policy": simulate_closed_loop(
            stepper, constant(model, true), Followers(batch, torch.arange(2)), first
        ),
    }
    style = StyleResult(
        pd.DataFrame({"driver": [p.driver for p in pairs], "score": [0.2, 0.8], "cluster": [0, 2]}),
        {},
        (0.3, 0.7),
    )
    result = evaluate(ComparedPairs(pairs, batch, first, style), {"test": loops}, model.space)
    table = result.table.set_index(["pair_id", "method"])
    assert table.loc[("p0", "policy"), "rmse_speed"] == pytest.approx(0, abs=1e-9)
    assert table.loc[("p1", "policy"), "improvement_over_driver_specific"] == pytest.approx(1)
    assert table.loc[("p1", "policy"), "parameter_t_r"] == pytest.approx(3.0)
    assert table.loc[("p1", "driver_specific"), "frames"] == 99
    real, simulated = (
        pairs[0].follower_speed[151:],
        result.trajectories[0].speed["driver_specific"][1:],
    )
    expected = math.sqrt(((real - simulated) ** 2).mean())
    assert table.loc[("p0", "driver_specific"), "rmse_speed"] == pytest.approx(expected)
    metrics = result.metrics()
    assert metrics["rmse_speed/driver_specific"] == pytest.approx(
        result.table.query("method == 'driver_specific'").rmse_speed.mean()
    )
    assert metrics["collisions/policy"] == 0


def test_a_collision_is_counted() -> None:
    model = Krauss()
    pairs = wavy_pairs(model, torch.tensor([[1.5, 0.1]], dtype=torch.float64))
    batch = PairBatch.of(pairs)
    first = torch.tensor([150])
    loop = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        constant(model, torch.tensor([[1.5, 0.1]]).double()),
        Followers(batch, torch.arange(1)),
        first,
    )
    crashed = loop._replace(gap=torch.where(torch.arange(loop.gap.shape[1]) == 7, -0.1, loop.gap))
    style = StyleResult(
        pd.DataFrame({"driver": ["test/0"], "score": [0.2], "cluster": [0]}), {}, (0.3, 0.7)
    )
    result = evaluate(
        ComparedPairs(pairs, batch, first, style),
        {"test": {"default": loop, "driver_specific": loop, "policy": crashed}},
        model.space,
    )
    assert result.metrics()["collisions/policy"] == 1
    assert result.metrics()["collisions/driver_specific"] == 0
