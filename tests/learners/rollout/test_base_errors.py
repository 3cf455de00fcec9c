"""What trajectories' losses are divided by."""

from __future__ import annotations

from dataclasses import replace

import torch

from cfx.learners.rollout.base_errors import BaseErrors
from cfx.objectives.rmse import GapRmse
from cfx.objectives.theil import TheilU
from tests.learners.made import TRUE, batch_of, gru, loop, placed, training_data, untrained


def test_errors_of_the_base_are_those_of_constant_parameters() -> None:
    data = training_data(networks=1, base=TRUE)
    errors = BaseErrors.of(data, placed(data, gru(), 0.0), 12)
    # The true parameters drive as the drivers did.
    assert float(errors.with_history[..., :30, 0].max()) < 1e-3
    result = untrained(replace(data, base=None), gru())
    found = loop(result, data, gru())
    squares = (found.speed - data.batch.follower_speed).square()[:, 1:]
    near = {"rtol": 1e-3, "atol": 1e-3}
    full = errors.full_trajectory[0, :, 0].double()
    torch.testing.assert_close(full, squares.mean(1).sqrt(), **near)
    horizon = errors.cold_start[0, :, 0, 0].double()
    torch.testing.assert_close(horizon, squares[:, :60].mean(1).sqrt(), **near)


def test_errors_are_those_of_the_jobs_objective() -> None:
    data = training_data(networks=1, base=TRUE)
    dataset = placed(data, gru(), 0.0)
    speed = BaseErrors.of(data, dataset, 12)
    gap = BaseErrors.of(replace(data, objective=GapRmse()), dataset, 12)
    assert torch.equal(gap.cold_start[..., 0], speed.cold_start[..., 1])
    assert torch.equal(gap.cold_start[..., 1], speed.cold_start[..., 1])
    assert (speed.floor, gap.floor) == (0.2, 1.0)


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
    theil = BaseErrors.of(replace(data, objective=TheilU()), dataset, 12)
    assert torch.equal(theil.over_horizon(batch).objective, theil.over_horizon(scaled).objective)
