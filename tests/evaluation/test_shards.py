"""Many pairs are simulated in shards, with the numbers that they have together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.core.local_engine import LocalEngine
from cfx.data.pairs import PairBatch, PairSet
from cfx.evaluation import closed_loop
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop, simulate_in_shards
from cfx.models.krauss import Krauss
from cfx.policies.agent import TrainedOn
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs
from tests.evaluation.test_closed_loop import adaptive

COUNTED = ("speed", "gap", "parameters", "at_limits", "outside")


def pairs_of_several_lengths() -> PairSet:
    model = Krauss()
    true = model.space.defaults().expand(5, -1)
    found = []
    for number, frames in enumerate((90, 60, 120, 40, 75)):
        one = wavy_pairs(model, true[:1], frames=frames, seed=number)[0]
        found.append(replace(one, pair_id=f"p{number}"))
    return PairSet(tuple(found), "test")


def test_shards_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_loop, "PAIRS_AT_ONCE", 2)
    model, pairs = Krauss(), pairs_of_several_lengths()
    batch = PairBatch.of(pairs)
    agent = adaptive(model, GruPolicy(hidden_size=4), len(pairs), 30)
    first = torch.tensor([30, 20, 50, 10, 30])
    network = torch.arange(len(pairs))
    arguments = (MemoryStepper(model, 0.1), agent, Followers(batch, network), first)
    whole = simulate_closed_loop(*arguments)
    parts = simulate_in_shards(LocalEngine(), *arguments)
    assert torch.equal(parts.counted, whole.counted)
    for name in COUNTED:
        one, other = getattr(parts, name), getattr(whole, name)
        assert one.shape == other.shape
        torch.testing.assert_close(counted(one, whole.counted), counted(other, whole.counted))
    torch.testing.assert_close(parts.beyond, whole.beyond)


class Remembering(LocalEngine):
    """Remembers its shards."""

    def map(self, work: Any, given: Any, report: Any, **options: Any) -> Any:
        self.shards = list(given)
        return super().map(work, self.shards, report, **options)


def test_a_shard_holds_nothing_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is pickled for a worker, whose memory is small."""
    monkeypatch.setattr(closed_loop, "PAIRS_AT_ONCE", 2)
    model, pairs = Krauss(), pairs_of_several_lengths()
    batch, engine = PairBatch.of(pairs), Remembering()
    agent = adaptive(model, GruPolicy(hidden_size=4), len(pairs), 30)
    agent = replace(agent, trained_on=TrainedOn({"content": "driver"}))
    first, network = torch.full((5,), 10), torch.arange(5)
    simulate_in_shards(engine, MemoryStepper(model, 0.1), agent, Followers(batch, network), first)
    assert [len(one.followers.batch) for one in engine.shards] == [2, 2, 1]
    row = batch.leader_speed[0].nbytes
    for one in engine.shards:
        rows = len(one.followers.batch)
        assert one.followers.batch.leader_speed.untyped_storage().nbytes() == rows * row
        assert one.first.untyped_storage().nbytes() == rows * one.first.itemsize
        assert len(one.agent.names) == len(one.agent.core.scaler.mean) == rows
        assert not one.agent.trained_on.pairs


def counted(values: Tensor, frames: Tensor) -> Tensor:
    return values[frames].double()


def test_few_pairs_are_one_call_with_the_same_bits() -> None:
    model, pairs = Krauss(), pairs_of_several_lengths()
    batch = PairBatch.of(pairs)
    agent = adaptive(model, GruPolicy(hidden_size=4), len(pairs), 30)
    arguments = (
        MemoryStepper(model, 0.1),
        agent,
        Followers(batch, torch.arange(5)),
        torch.full((5,), 10),
    )
    parts = simulate_in_shards(LocalEngine(), *arguments)
    assert torch.equal(parts.speed, simulate_closed_loop(*arguments).speed)


def test_a_trimmed_batch_has_the_frames_of_its_longest_pair() -> None:
    batch = PairBatch.of(pairs_of_several_lengths())
    short = batch[torch.tensor([1, 3])].trimmed()
    assert short.mask.shape == short.leader_speed.shape == (2, 60)
    assert torch.equal(short.follower_position, batch.follower_position[[1, 3], :60])
