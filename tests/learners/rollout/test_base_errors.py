"""What trajectories' losses are divided by."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.calibration.rmse import GapRmse
from cfx.calibration.theil_u import TheilInequality
from cfx.learners.rollout import loss
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.loss import BaseErrors
from cfx.models.krauss import Krauss
from cfx.simulation.rollout import MemoryStepper
from tests.learners.made import TRUE, batch_of, gru, loop, placed, training_data, untrained


def test_errors_of_the_base_are_those_of_constant_parameters() -> None:
    data = training_data(networks=1, base=TRUE)
    errors = BaseErrors.of(data, placed(data, gru(), 0.0), 12)
    # The true parameters drive as the drivers did.
    with_history = errors.over_windows[errors.driver_row]
    assert float(with_history[..., :30, 0].max()) < 1e-3
    result = untrained(replace(data, pairs=replace(data.pairs, base=None)), gru())
    found = loop(result, data, gru())
    squares = (found.speed - data.batch.follower_speed).square()[:, 1:]
    near = {"rtol": 1e-3, "atol": 1e-3}
    full = errors.over_pair[errors.pooled_row][0, :, 0].double()
    torch.testing.assert_close(full, squares.mean(1).sqrt(), **near)
    horizon = errors.over_windows[errors.pooled_row][0, :, 0, 0].double()
    torch.testing.assert_close(horizon, squares[:, :60].mean(1).sqrt(), **near)


def test_errors_are_those_of_the_jobs_objective() -> None:
    data = training_data(networks=1, base=TRUE)
    dataset = placed(data, gru(), 0.0)
    speed = BaseErrors.of(data, dataset, 12)
    gap = BaseErrors.of(replace(data, objective=GapRmse()), dataset, 12)
    assert torch.equal(gap.over_windows[..., 0], speed.over_windows[..., 1])
    assert torch.equal(gap.over_windows[..., 1], speed.over_windows[..., 1])
    assert (speed.objective.floor, gap.objective.floor) == (0.2, 1.0)


def test_divisors_grow_with_the_scale_of_a_trajectory_where_the_objective_has_a_unit() -> None:
    data = training_data(networks=1, base=TRUE)
    dataset = placed(data, gru(), 0.0)
    start = torch.full((1, 6), 3)
    batch = batch_of(dataset, start, torch.ones_like(start).bool())
    scaled = batch._replace(scale=torch.full((1, 6), 2.0))
    errors = BaseErrors.of(data, dataset, 12)
    one, two = errors.over_horizon(batch), errors.over_horizon(scaled)
    torch.testing.assert_close(two.objective - 0.2, 2.0 * (one.objective - 0.2))
    torch.testing.assert_close(two.gap - 1.0, 2.0 * (one.gap - 1.0))
    theil = BaseErrors.of(replace(data, objective=TheilInequality()), dataset, 12)
    assert torch.equal(theil.over_horizon(batch).objective, theil.over_horizon(scaled).objective)


def test_networks_that_share_pairs_and_bases_share_their_errors() -> None:
    data = training_data(networks=3, base=TRUE.repeat(3, 1))
    dataset = placed(data, gru(), 0.0)
    assert len(dataset.recordings.batch) == 6
    errors = BaseErrors.of(data, dataset, 12)
    assert len(errors.over_windows) == 12
    assert torch.equal(errors.driver_row[0], errors.driver_row[2])
    one = data.pairs.split.frame[:6].clone()
    one[0] = 120  # one network's training part of a pair ends earlier
    split = replace(data.pairs.split, frame=torch.cat([one, data.pairs.split.frame[6:]]))
    data = replace(data, pairs=replace(data.pairs, split=split))
    assert len(placed(data, gru(), 0.0).recordings.batch) == 7


def test_errors_of_some_networks_are_those_of_all() -> None:
    start = torch.tensor([[4.0, 0.8], [3.0, 0.5], [2.0, 0.2]]).double().repeat_interleave(6, 0)
    data = training_data(networks=3, base=TRUE.repeat(3, 1), start=start)
    dataset = placed(data, gru(), 0.0)
    whole = BaseErrors.of(data, dataset, 12)
    part, networks = whole.only(slice(1, 3)), dataset.only(slice(1, 3))
    assert len(part.over_windows) == 18
    batch = _everywhere(networks)
    for one, two in zip(
        part.over_horizon(batch), whole.over_horizon(_everywhere(dataset)), strict=True
    ):
        assert torch.equal(one, two[1:])
    for one, two in zip(
        part.over_full_trajectory(batch),
        whole.over_full_trajectory(_everywhere(dataset)),
        strict=True,
    ):
        assert torch.equal(one, two[1:])


def test_a_kernel_finds_the_errors_that_pytorch_does(monkeypatch: pytest.MonkeyPatch) -> None:
    data = training_data(networks=2, base=TRUE.repeat(2, 1))
    dataset = placed(data, gru(), 0.0)
    eager = BaseErrors.of(
        replace(data, stepper=MemoryStepper(Krauss(), 0.1, compile="never")), dataset, 12
    )
    kernel = BaseErrors.of(
        replace(data, stepper=MemoryStepper(Krauss(), 0.1, compile="always")), dataset, 12
    )
    torch.testing.assert_close(kernel.over_windows, eager.over_windows)
    torch.testing.assert_close(kernel.over_pair, eager.over_pair)
    # However many pairs are simulated at once.
    monkeypatch.setattr(loss, "_AT_ONCE", 1)
    apart = BaseErrors.of(data, dataset, 12)
    torch.testing.assert_close(apart.over_windows, eager.over_windows)


def _everywhere(dataset: RolloutDataset) -> RolloutBatch:
    """Returns a cold start and another trajectory of each driver."""
    networks, drivers = dataset.pair.shape
    place = torch.arange(drivers).repeat(2).expand(networks, -1)
    start = torch.arange(2 * drivers).expand(networks, -1)
    cold_start = (torch.arange(2 * drivers) < drivers).expand(networks, -1)
    last, weight = dataset.last.repeat(1, 2), torch.ones_like(place).float()
    return RolloutBatch(place, start, cold_start, last, weight)
