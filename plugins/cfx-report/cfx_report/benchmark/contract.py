"""What every rival of the benchmark must hold, as functions that a test calls.

    from cfx_report.benchmark.contract import CHECKS, tried

    @pytest.mark.parametrize("check", CHECKS)
    def test_mine(check):
        check(tried(Mine()))

Shapes: P pairs, T frames, S samples.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import cfx
from cfx.plugin import PairBatch, PairSet
from cfx_report.benchmark.rival import Driver, Rival
from cfx_report.benchmark.segments import Segments, whole

SEED = 3


class Tried(NamedTuple):
    """A rival that has learned from synthetic drivers, and what it is to drive.

    Attributes:
        rival: itself.
        pairs: that it has learned from.
        driver: what learning gave.
        segments: P whole pairs, driven from their 5th second on.
    """

    rival: Rival
    pairs: PairSet
    driver: Driver
    segments: Segments


@cache
def _pairs() -> PairSet:
    """Returns synthetic drivers on two roads."""
    read = cfx.read(dataset="synthetic", pairs=6, frames=260, min_duration=0).selected
    placed = []
    for number, pair in enumerate(read):
        placed.append(dataclasses.replace(pair, site="AB"[number % 2]))
    return dataclasses.replace(read, pairs=tuple(placed))


def tried(rival: Rival) -> Tried:
    """Lets a rival learn from a few synthetic drivers; give it a small budget."""
    pairs = _pairs()
    return Tried(rival, pairs, rival.fit(pairs, SEED), whole(list(pairs[:3]), [50, 60, 70]))


def says_where_it_is_published(tried: Tried) -> None:
    assert type(tried.rival).reference.strip()


def drives_finite_speeds(tried: Tried) -> None:
    speed = _driven(tried.driver, tried.segments)
    batch = tried.segments.batch()
    assert speed.shape == batch.mask.shape
    later = _later(tried.segments, batch)
    assert bool(speed[later].isfinite().all())
    assert bool((speed[later] >= 0.0).all())


def learns_the_same_from_the_same_seed(tried: Tried) -> None:
    again = tried.rival.fit(tried.pairs, SEED)
    later = _later(tried.segments, tried.segments.batch())
    first, second = _driven(tried.driver, tried.segments), _driven(again, tried.segments)
    assert torch.equal(first[later], second[later])


def does_not_look_ahead(tried: Tried) -> None:
    """Whatever the follower does after the last measured frame changes nothing."""
    segments = tried.segments
    blank, batch = segments.blanked(), segments.batch()
    later = torch.arange(batch.mask.shape[1]) > segments.first[:, None]
    lying = dataclasses.replace(
        blank,
        follower_position=torch.where(later, 1e3, batch.follower_position),
        follower_speed=torch.where(later, 1e3, batch.follower_speed),
        follower_acceleration=torch.where(later, 1e3, batch.follower_acceleration),
    )
    seen = tried.driver.drive(lying, segments.first, None)
    compared = _later(segments, batch)
    assert torch.equal(seen[compared], _driven(tried.driver, segments)[compared])


def drives_each_as_if_alone(tried: Tried) -> None:
    together = _driven(tried.driver, tried.segments)
    for number, pair in enumerate(tried.segments.pairs):
        alone = whole([pair], [int(tried.segments.first[number])])
        speed = _driven(tried.driver, alone)
        later = slice(int(alone.first[0]) + 1, len(pair))
        np.testing.assert_allclose(speed[0, later], together[number, later], rtol=0, atol=1e-6)


def forecasts_samples(tried: Tried) -> None:
    segments = tried.segments
    blank = segments.blanked()
    paths = tried.driver.forecast(blank, segments.first, SEED, 3)
    later = _later(segments, segments.batch())
    if not tried.driver.is_stochastic:
        assert len(paths) == 1
        return
    assert len(paths) == 3
    assert not torch.equal(paths[0][later], paths[1][later])
    again = tried.driver.forecast(blank, segments.first, SEED, 3)
    assert torch.equal(paths[:, later], again[:, later])
    assert bool((paths[:, later] >= 0.0).all())


CHECKS = (
    says_where_it_is_published,
    drives_finite_speeds,
    learns_the_same_from_the_same_seed,
    does_not_look_ahead,
    drives_each_as_if_alone,
    forecasts_samples,
)
"""All of them."""


def _driven(driver: Driver, segments: Segments) -> Tensor:
    return driver.drive(segments.blanked(), segments.first, None)


def _later(segments: Segments, batch: PairBatch) -> Tensor:
    frames = torch.arange(batch.mask.shape[1])
    return batch.mask & (frames > segments.first[:, None])
