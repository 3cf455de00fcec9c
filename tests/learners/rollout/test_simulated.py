"""Simulated drivers, from whom networks learn beside the recorded ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cfx.data.signals import RECORDED
from cfx.learners.rollout import RolloutLearner
from cfx.learners.rollout.simulated import (
    QUEUES,
    STOP_AND_GO,
    queue_drivers,
    stop_and_go_drivers,
    with_simulated_drivers,
)
from cfx.simulation.queues import QUEUE
from tests.learners.made import QUICK, gru, module_of, placed, training_data


@pytest.mark.parametrize("sites", [None, ("a", "b") * 6])
def test_each_network_learns_from_them_beside_its_own_pairs(sites: tuple[str, ...] | None) -> None:
    data = training_data(networks=2, sites=sites)
    data = replace(data, pairs=replace(data.pairs, base=data.pairs.start + 0.1))
    more = with_simulated_drivers(data, 3, 2)
    recorded, found = len(data.recorded), more.pairs
    assert found.network.tolist() == [0] * 11 + [1] * 11
    assert found.index[:11].tolist() == found.index[11:].tolist() == list(range(11))
    kept = found.index < recorded
    for name in ("index", "network", "start", "base"):
        assert torch.equal(getattr(found, name)[kept], getattr(data.pairs, name))
    assert torch.equal(found.split.frame[kept], data.pairs.split.frame)
    assert (found.split.frame[~kept] == more.recorded.lengths[recorded:].repeat(2) - 1).all()
    assert torch.equal(found.base[~kept], data.pairs.start[:1].expand(10, -1))
    assert found.sites == ((sites or ("",) * 6)[:6] + (STOP_AND_GO,) * 3 + (QUEUES,) * 2) * 2
    assert len(set(found.drivers or ())) == 11
    for name in (*RECORDED, "leader_length", "lengths", "mask"):
        assert torch.equal(getattr(more.recorded, name)[:recorded], getattr(data.recorded, name))


def test_they_drive_in_stop_and_go_traffic_and_differ() -> None:
    pairs = stop_and_go_drivers(4, 0.2, 10_000, seed=3)
    assert len(pairs) == len({pair.pair_id for pair in pairs}) == 4
    speeds = [pair.follower_speed for pair in pairs]
    assert all(0.5 < speed.mean() < 7.0 and speed.max() < 10.0 for speed in speeds)
    assert (
        len({round(float((pair.gap / pair.follower_speed.clip(1)).mean()), 3) for pair in pairs})
        == 4
    )
    again, other = (stop_and_go_drivers(4, 0.2, 10_000, seed=seed) for seed in (3, 4))
    assert all(
        (a.follower_speed == b.follower_speed).all() for a, b in zip(pairs, again, strict=True)
    )
    assert not any(
        (a.follower_speed == b.follower_speed).all() for a, b in zip(pairs, other, strict=True)
    )


@pytest.mark.parametrize(("dt", "frames", "expected"), [(0.5, 400, 120), (0.1, 300, 300)])
def test_they_last_a_minute_or_as_long_as_recordings(dt: float, frames: int, expected: int) -> None:
    pairs = stop_and_go_drivers(1, dt, frames, seed=0)
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


def test_a_simulated_queue_has_the_saturation_flow_of_the_highway_capacity_manual() -> None:
    pairs = queue_drivers(20 * QUEUE, 0.2, 300, seed=0)
    headways, standing = [], []
    for queue in range(20):
        platoon = pairs[queue * QUEUE : (queue + 1) * QUEUE]
        first = platoon[0]
        stands = (first.leader_speed == 0).nonzero()[0][-1]
        standing += [pair.gap[stands] for pair in platoon if pair.follower_speed[stands] < 0.05]
        crossed = []
        for pair in platoon:
            beyond = (pair.follower_position > first.leader_position[stands]).nonzero()[0]
            if len(beyond):
                crossed.append(beyond[0] * pair.dt)
        # The first vehicle of a queue leads; those from the fifth on count.
        headways += np.diff(crossed)[3:].tolist()
    assert 1700 < 3600 / np.mean(headways) < 1950
    assert 1.5 < np.mean(standing) < 3.0


@pytest.mark.parametrize("features", [(), ("time_headway",)])
def test_who_leaves_a_queue_is_known_as_a_recorded_driver_of_the_network(
    features: tuple[str, ...],
) -> None:
    data = training_data(networks=2)
    data = with_simulated_drivers(data, 2, 5)
    dataset = placed(data, gru(driver_features=features))
    recorded = dataset.pair < len(dataset.recordings.pair) - 7
    assert dataset.in_queue.sum(1).tolist() == [5, 5]
    assert not (dataset.in_queue & recorded).any()
    others = dataset.known_as == dataset.pair
    assert others[~dataset.in_queue].all()
    if not features:
        assert others.all()
        return
    for network, queue in enumerate(dataset.in_queue):
        of_network = dataset.pair[network][recorded[network]]
        known_as = dataset.known_as[network][queue]
        assert torch.isin(known_as, of_network).all()
        rows = dataset.pair[network][queue]
        gaps = dataset.recordings.time_gap
        order = gaps[rows].argsort(stable=True)
        assert (gaps[known_as[order]].diff() >= 0).all()


def test_nothing_makes_a_motorway_of_their_street() -> None:
    data = training_data(networks=1)
    data = replace(data, pairs=replace(data.pairs, base=data.pairs.start))
    data = with_simulated_drivers(data, 0, 6)
    sampler = module_of(data, cold_start_fraction=1.0, speed_shift=20.0).sampler
    shifted = torch.zeros(0)
    for step in range(20):
        batch = sampler.training(step)
        in_queue = sampler.dataset.in_queue.gather(1, batch.place)
        assert batch.shift is not None
        assert (batch.shift[in_queue] == 0).all()
        shifted = torch.cat([shifted, batch.shift[~in_queue]])
    assert (shifted > 0).any()
