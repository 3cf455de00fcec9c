"""Simulated drivers, from whom networks learn beside the recorded ones."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.data.signals import RECORDED
from cfx.learners.rollout import RolloutLearner
from cfx.learners.rollout.simulated import SITE, simulated_drivers, with_simulated_drivers
from tests.learners.made import QUICK, gru, training_data


@pytest.mark.parametrize("sites", [None, ("a", "b") * 6])
def test_each_network_learns_from_them_beside_its_own_pairs(sites: tuple[str, ...] | None) -> None:
    data = training_data(networks=2, sites=sites)
    data = replace(data, pairs=replace(data.pairs, base=data.pairs.start + 0.1))
    more = with_simulated_drivers(data, 5)
    recorded, found = len(data.recorded), more.pairs
    assert found.network.tolist() == [0] * 11 + [1] * 11
    assert found.index[:11].tolist() == found.index[11:].tolist() == list(range(11))
    kept = found.index < recorded
    for name in ("index", "network", "start", "base"):
        assert torch.equal(getattr(found, name)[kept], getattr(data.pairs, name))
    assert torch.equal(found.split.frame[kept], data.pairs.split.frame)
    assert (found.split.frame[~kept] == more.recorded.lengths[recorded:].repeat(2) - 1).all()
    assert torch.equal(found.base[~kept], data.pairs.start[:1].expand(10, -1))
    assert found.sites == ((sites or ("",) * 6)[:6] + (SITE,) * 5) * 2
    assert len(set(found.drivers or ())) == 11
    for name in (*RECORDED, "leader_length", "lengths", "mask"):
        assert torch.equal(getattr(more.recorded, name)[:recorded], getattr(data.recorded, name))


def test_they_drive_in_stop_and_go_traffic_and_differ() -> None:
    pairs = simulated_drivers(4, 0.2, 10_000, seed=3)
    assert len(pairs) == len({pair.pair_id for pair in pairs}) == 4
    speeds = [pair.follower_speed for pair in pairs]
    assert all(0.5 < speed.mean() < 7.0 and speed.max() < 10.0 for speed in speeds)
    assert (
        len({round(float((pair.gap / pair.follower_speed.clip(1)).mean()), 3) for pair in pairs})
        == 4
    )
    again, other = (simulated_drivers(4, 0.2, 10_000, seed=seed) for seed in (3, 4))
    assert all(
        (a.follower_speed == b.follower_speed).all() for a, b in zip(pairs, again, strict=True)
    )
    assert not any(
        (a.follower_speed == b.follower_speed).all() for a, b in zip(pairs, other, strict=True)
    )


@pytest.mark.parametrize(("dt", "frames", "expected"), [(0.5, 400, 120), (0.1, 300, 300)])
def test_they_last_a_minute_or_as_long_as_recordings(dt: float, frames: int, expected: int) -> None:
    pairs = simulated_drivers(1, dt, frames, seed=0)
    assert [len(pair) for pair in pairs] == [expected]


def test_networks_know_slower_traffic_then() -> None:
    data = training_data(networks=1)
    fast = replace(data.recorded, follower_speed=data.recorded.follower_speed + 20.0)
    fast = replace(fast, leader_speed=fast.leader_speed + 20.0)
    data = replace(data, recorded=fast)

    def slowest(count: int) -> float:
        settings = {**QUICK, "epochs": 1, "steps": 1, "simulated_drivers": count}
        found = RolloutLearner(**settings).fit(gru(), data).valid_range
        assert found is not None
        return float(found.low[0, 0])

    assert slowest(0) > 10.0
    assert slowest(6) < 5.0
