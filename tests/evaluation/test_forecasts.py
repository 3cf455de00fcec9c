"""Forecasts: where origins lie, and what may be read at them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.evaluation import forecasts
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.forecasts import LeaderFuture, Origins, measured_paths
from cfx.models.krauss import Krauss
from cfx.policies.agent import Agent
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from tests.drives import simulate_from_origins, straight_pairs, wavy_pairs
from tests.evaluation.test_closed_loop import adaptive, constant

MODEL = Krauss()
STEPS = 30


@pytest.fixture(scope="module")
def batch() -> PairBatch:
    true = MODEL.space.defaults() + torch.tensor([[0.0, 0.0], [0.8, 0.2], [1.5, 0.1]]).double()
    return PairBatch.of(wavy_pairs(MODEL, true))


def policy(networks: int = 3) -> Agent:
    """Answers something else in each window."""
    return adaptive(MODEL, GruPolicy(hidden_size=6, inputs="speeds"), networks, 2 * 5)


def test_origins_lie_between_the_first_and_the_last() -> None:
    origins = Origins.every(5, torch.tensor([10, 7, 90]), torch.tensor([21, 7, 80]))
    assert origins.pair.tolist() == [0, 0, 0, 1]
    assert origins.frame.tolist() == [10, 15, 20, 7]


def test_a_driver_with_the_true_parameters_is_forecast_exactly(batch: PairBatch) -> None:
    true = MODEL.space.defaults() + torch.tensor([[0.0, 0.0], [0.8, 0.2], [1.5, 0.1]]).double()
    origins = Origins.every(20, torch.tensor([40, 50, 60]), torch.tensor([269, 269, 269]))
    paths = simulate_from_origins(
        MemoryStepper(MODEL, 0.1),
        constant(MODEL, true),
        Followers(batch, torch.arange(3)),
        origins,
        STEPS,
    )
    measured, recorded = measured_paths(batch, origins, STEPS)
    assert bool(recorded.all())
    torch.testing.assert_close(paths.speed, measured.speed)
    torch.testing.assert_close(paths.travelled, measured.travelled, atol=1e-9, rtol=0)


@pytest.mark.parametrize("shard_bytes", [1, 1 << 28])
def test_each_origin_is_a_closed_loop_of_its_own(
    batch: PairBatch, shard_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch of origins, in shards of any size, is what each origin alone gives."""
    monkeypatch.setattr(forecasts, "_SHARD_BYTES", shard_bytes)
    agent, stepper = policy(), MemoryStepper(MODEL, 0.1)
    origins = Origins(torch.tensor([0, 2, 2]), torch.tensor([33, 100, 250]))
    network = torch.tensor([2, 0, 1])
    paths = simulate_from_origins(stepper, agent, Followers(batch, network), origins, STEPS)
    for k, (pair, frame) in enumerate(
        zip(origins.pair.tolist(), origins.frame.tolist(), strict=True)
    ):
        alone = simulate_closed_loop(
            stepper,
            agent,
            Followers(batch[pair : pair + 1], network[pair : pair + 1]),
            torch.tensor([frame]),
        )
        torch.testing.assert_close(paths.speed[k], alone.speed[0, : STEPS + 1])


@pytest.mark.parametrize("leader", ["given", "constant_speed", "constant_acceleration"])
def test_nothing_is_read_that_is_not_known_at_the_origin(
    batch: PairBatch, leader: LeaderFuture
) -> None:
    """What the follower does afterwards changes no forecast, nor the leader if predicted."""
    origins = Origins(torch.tensor([0, 1, 2]), torch.tensor([100, 120, 140]))
    after = torch.arange(batch.mask.shape[1]) > origins.frame[:, None]
    names = ["follower_position", "follower_speed", "follower_acceleration"]
    if leader != "given":
        names += ["leader_position", "leader_speed", "leader_acceleration"]
    changed = {}
    for name in names:
        signal = getattr(batch, name)
        changed[name] = torch.where(after, 0.3 * signal - 7.0, signal)
    found = []
    for one in (batch, replace(batch, **changed)):
        for agent in (policy(), constant(MODEL, MODEL.space.defaults().expand(3, -1))):
            found.append(
                simulate_from_origins(
                    MemoryStepper(MODEL, 0.1),
                    agent,
                    Followers(one, torch.arange(3)),
                    origins,
                    STEPS,
                    leader=leader,
                )
            )
    assert torch.equal(found[0].speed, found[2].speed)
    assert torch.equal(found[1].travelled, found[3].travelled)


def test_a_leader_at_constant_speed_is_predicted_exactly_at_constant_speed() -> None:
    batch = PairBatch.of(straight_pairs([200, 150]))
    origins = Origins(torch.tensor([0, 1]), torch.tensor([60, 70]))
    agent = constant(MODEL, MODEL.space.defaults().expand(2, -1))
    found: list[Tensor] = []
    for leader in ("given", "constant_speed", "constant_acceleration"):
        paths = simulate_from_origins(
            MemoryStepper(MODEL, 0.1),
            agent,
            Followers(batch, torch.arange(2)),
            origins,
            STEPS,
            leader=leader,
        )
        found.append(paths.travelled)
    torch.testing.assert_close(found[0], found[1])
    torch.testing.assert_close(found[0], found[2])
