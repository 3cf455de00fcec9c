"""The prior: it holds what a recording does not determine, and hardly moves what it does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from cfx.calibration.botorch import BotorchOptimizer
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.losses import Prior, SegmentLosses, prior_weight
from cfx.calibration.optimizers import Optimizer
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.rmse import SpeedRmse
from cfx.calibration.shards import Solver
from cfx.core.parameters import Parameter, ParameterSpace, squashed
from cfx.data.pairs import PairBatch
from cfx.models.base import Follower, Leader
from cfx.models.idm import IDM
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

MODEL = IDM()
TRUE = torch.tensor([[30.0, 1.2, 1.5, 1.1, 1.6], [36.0, 1.8, 2.5, 0.9, 1.9]], dtype=torch.float64)
PAIRS = wavy_pairs(MODEL, TRUE, frames=300)
BATCH = PairBatch.of(PAIRS)


def found(prior: float, folder: Path | None = None) -> torch.Tensor:
    calibrator = Calibrator(
        Solver(
            MemoryStepper(MODEL, 0.1),
            GradientSearch(samples=2048),
            seed=0,
            memory=1 << 28,
            prior=prior,
        ),
        cache=Cache(folder),
    )
    return calibrator.driver_specific(PAIRS, BATCH, BATCH.lengths - 1)


def losses() -> SegmentLosses:
    pair = torch.arange(2)
    return SegmentLosses.of_segments(
        MemoryStepper(MODEL, 0.1), SpeedRmse(), BATCH, pair, pair * 0, BATCH.lengths - 1
    )


def test_the_default_costs_nothing_and_distance_costs_more() -> None:
    default = MODEL.space.to_unit(MODEL.space.defaults())
    near = default[None, None].expand(2, 1, -1)
    with_prior = replace(losses(), prior=Prior.of(losses(), near, squashed(default), 0.01))
    far = torch.full_like(near, 0.9)
    plain = losses()
    torch.testing.assert_close(with_prior(near), plain(near))
    assert bool((with_prior(far) > plain(far)).all())
    both = torch.cat([near, far], 1)
    torch.testing.assert_close(with_prior.select(1, 2)(both[1:]), with_prior(both)[1:])


def test_what_is_determined_is_found_and_what_is_not_stays() -> None:
    """These drivers never go faster than 20 m/s, so their data say little of v0."""
    values = found(prior_weight("weak"))
    time_gap = values[:, 1]
    assert bool(((time_gap - TRUE[:, 1]).abs() < 0.15).all())
    default = MODEL.space["v0"].default
    assert bool(((values[:, 0] - default).abs() < 8.0).all())


class Indifferent(IDM):
    """IDM with a parameter that nothing depends on, and one that matters below half its range."""

    parameters = ParameterSpace.of(
        *IDM.parameters,
        Parameter("mood", "1", 0.0, 4.0, 1.0, "nothing"),
        Parameter("most", "m/s2", 0.0, 20.0, 12.0, "bound that these drivers do not reach"),
    )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        speed = super().next_speed(follower, leader, p, dt)
        return torch.minimum(speed, follower.speed + p["most"] * dt)


@pytest.mark.parametrize(
    "optimizer",
    [
        RandomSearch(samples=256),
        GradientSearch(samples=512),
        BotorchOptimizer(screening=64, initial=6, iterations=2),
    ],
    ids=lambda one: type(one).__name__,
)
def test_what_does_not_matter_returns_to_its_default(optimizer: Optimizer) -> None:
    model = Indifferent()
    calibrator = Calibrator(
        Solver(
            MemoryStepper(model, 0.1), optimizer, seed=0, memory=1 << 28, prior=prior_weight("weak")
        ),
        cache=Cache(None),
    )
    last = torch.full_like(BATCH.lengths, 100)
    own = calibrator.driver_specific(PAIRS, BATCH, last)
    pooled = calibrator.pooled(PAIRS, BATCH, last, torch.ones((1, 2), dtype=torch.bool))
    unit = model.space.to_unit(torch.cat([own, pooled]))
    away = (unit - model.space.to_unit(model.space.defaults()))[:, -2:].abs()
    assert float(away.max()) < 1e-3


def test_without_prior_and_with_it_are_different_entries(tmp_path: Path) -> None:
    plain = found(0.0, tmp_path)
    held = found(0.01, tmp_path)
    assert not torch.equal(plain, held)
    assert torch.equal(found(0.0, tmp_path), plain)
    assert torch.equal(found(0.01, tmp_path), held)
