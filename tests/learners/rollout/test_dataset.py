"""Drivers placed on networks: who is kept for validation, and what is known of each."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.core.parameters import squashed
from cfx.learners.base import TrainingPairs
from cfx.learners.rollout import dataset as dataset_module
from cfx.learners.rollout.dataset import time_gaps
from cfx.learners.rollout.loss import BaseErrors
from cfx.policies.driver_features import measure
from tests.learners.made import TRUE, batch_of, gru, placed, training_data


def test_networks_read_the_driver_features_of_each_of_their_drivers() -> None:
    """The mean of the training drivers stands for those that are unknown, and for cold starts."""
    data = training_data(networks=1, base=TRUE)
    data.pairs.split.frame[1] = 120
    policy = gru(driver_features=("time_gap", "time_headway"))
    dataset = placed(data, policy)
    cold_start = torch.tensor([[True, False, False, False, False, False]])
    start = torch.zeros_like(cold_start).long()
    features = dataset.condition(batch_of(dataset, start, cold_start)).features
    frame = data.pairs.split.frame
    expected = measure(data.batch, policy.driver_features, 0.1, 0 * frame, frame).float()
    torch.testing.assert_close(features[0, 2:, 2:], expected[dataset.pair[0, 2:]])
    usual = dataset.scaler.mean[:, -2:].expand(2, -1)
    torch.testing.assert_close(features[0, :2, 2:], usual)
    torch.testing.assert_close(features[0, 1:, :2], squashed(dataset.base)[0, 1:])
    trained_on = expected[dataset.pair[0, dataset.trains[0]]]
    known = trained_on[~trained_on.isnan().any(-1)]
    scaler, near = dataset.scaler, {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(scaler.mean[0, -2:], known.mean(0), **near)
    torch.testing.assert_close(scaler.scale[0, -2:], known.std(0, correction=0), **near)


def test_networks_of_an_ensemble_keep_other_drivers_for_validation_and_read_alike() -> None:
    data = training_data()
    dataset = placed(data, gru(), 0.34, ensemble_size=5)
    assert len({tuple(row) for row in dataset.validates[:5].tolist()}) > 1
    assert dataset.pair[:5].tolist() == [list(range(6))] * 5
    # Both networks learn from the same pairs, which are held once.
    assert dataset.pair[5:].tolist() == [list(range(6))] * 5
    mean = dataset.scaler.mean
    assert torch.equal(mean[:5], mean[:1].expand(5, -1))
    assert torch.equal(mean[5:], mean[5:6].expand(5, -1))
    errors = BaseErrors.of(data, dataset, 12)
    assert errors.driver_row.shape == errors.pooled_row.shape == (10, 6)


def test_a_network_of_few_drivers_keeps_the_end_of_their_trajectories() -> None:
    data = training_data(networks=1)
    few = replace(
        data,
        pairs=TrainingPairs(
            index=data.pairs.index[:2],
            split=data.pairs.split[torch.arange(2)],
            network=data.pairs.network[:2],
            start=data.pairs.start[:2],
            drivers=("a", "b"),
        ),
    )
    dataset = placed(few, gru())
    assert bool((dataset.trains & dataset.validates).all())
    assert dataset.until.tolist() == [[int(0.75 * 259)] * 2]


def test_one_driver_is_never_on_both_sides() -> None:
    names = ("a", "a", "b", "c", "d", "e")
    dataset = placed(training_data(drivers=names * 2), gru(), 0.4, seed=3)
    for row in dataset.validates.tolist():
        kept, others = set(), set()
        for name, is_kept in zip(names, row, strict=True):
            (kept if is_kept else others).add(name)
        assert kept
        assert not kept & others


def test_pairs_that_are_read_some_after_the_other_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data, policy = training_data(networks=2, base=TRUE.repeat(2, 1)), gru()
    whole, gaps = placed(data, policy), time_gaps(data)
    monkeypatch.setattr(dataset_module, "_PAIRS_AT_ONCE", 4)
    parts = placed(data, policy)
    found, expected = parts.recordings, whole.recordings
    assert torch.equal(found.batch.follower_position, expected.batch.follower_position)
    assert torch.equal(found.batch.mask, expected.batch.mask)
    assert torch.equal(found.tokens, expected.tokens)
    assert torch.equal(found.time_gap, expected.time_gap)
    assert torch.equal(time_gaps(data), gaps)
    one, other = BaseErrors.of(data, whole, 12), BaseErrors.of(data, parts, 12)
    assert torch.equal(one.over_windows, other.over_windows)


def test_training_data_hold_each_recording_once() -> None:
    data = training_data(networks=3)
    assert len(data.recorded) == 6
    assert len(data.batch) == len(data.pairs) == 18
    assert torch.equal(data.batch.follower_speed[6:12], data.recorded.follower_speed)
