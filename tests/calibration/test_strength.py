"""How strong the prior of driver-specific parameters is: chosen on stretches that are held out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import cfx
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.calibration.strength import FITTED, MOST, WEIGHTS, PriorStrength
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError
from cfx.models.krauss import Krauss
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset


def test_it_is_where_a_parabola_has_the_least_error_for_all_that_may_be_used() -> None:
    tried = PriorStrength({0.01: 2.0, 0.1: 1.0, 1.0: 2.0}, 5)
    assert tried.weight == pytest.approx(0.1 * FITTED)
    assert PriorStrength({0.01: 3.0, 0.1: 2.0, 1.0: 1.0}, 5).weight == pytest.approx(FITTED)
    assert PriorStrength({0.01: 1.0, 0.1: 2.0, 1.0: 3.0}, 5).weight == WEIGHTS[0]
    assert PriorStrength({0.01: math.nan, 0.1: math.nan}, 5).weight == WEIGHTS[0]
    assert "by weight 0.01: 2.000, 0.1: 1.000, 1: 2.000 m/s" in tried.worded("m/s")


@pytest.fixture
def calibrator() -> Calibrator:
    solver = Solver(
        MemoryStepper(Krauss(), 0.1), RandomSearch(samples=64), 0, prior=0.01, strength="chosen"
    )
    return Calibrator(solver, cache=Cache(None))


def test_what_is_chosen_is_what_is_calibrated_with(calibrator: Calibrator) -> None:
    pairs = SyntheticDataset(pairs=4, frames=300).load()
    batch = PairBatch.of(pairs)
    last = torch.full((len(pairs),), 240)
    found = calibrator.driver_specific(pairs, batch, last)
    (strength,) = calibrator.strengths
    assert set(strength.errors) == set(WEIGHTS)
    given = replace(calibrator.solver, prior=strength.weight, strength=None)
    same = Calibrator(given, cache=Cache(None)).driver_specific(pairs, batch, last)
    assert torch.equal(found, same)


def test_a_number_is_the_strength_of_driver_specific_parameters_alone() -> None:
    pairs = cfx.read(dataset="synthetic", pairs=3, frames=200)
    quick = {"optimizer": "random", "optimizer.samples": 64}
    by_prior = {}
    for prior in ("weak", 0.01, 1.0):
        by_prior[prior] = cfx.calibrate(pairs, **quick, **{"calibration.prior": prior})
    assert by_prior[0.01].parameters.equals(by_prior["weak"].parameters)
    assert not by_prior[1.0].parameters.equals(by_prior["weak"].parameters)
    assert by_prior[1.0].pooled.equals(by_prior["weak"].pooled)


@pytest.mark.parametrize("prior", [0.0, -1.0, math.inf, "true", "strong"])
def test_other_strengths_are_refused(prior: float | str) -> None:
    pairs = cfx.read(dataset="synthetic", pairs=1, frames=60)
    with pytest.raises(ConfigError, match=r"calibration\.prior"):
        cfx.calibrate(pairs, **{"calibration.prior": prior})


def test_of_many_pairs_some_from_first_to_last_are_tried(calibrator: Calibrator) -> None:
    pairs = SyntheticDataset(pairs=MOST + 8, frames=60).load()
    last = torch.full((len(pairs),), 50)
    assert calibrator.prior_strength(pairs, PairBatch.of(pairs), last).pairs == (MOST + 8) // 2


def test_nothing_after_what_may_be_used_is_read(calibrator: Calibrator) -> None:
    pairs = SyntheticDataset(pairs=4, frames=300).load()
    batch = PairBatch.of(pairs)
    last = torch.full((len(pairs),), 200)
    before = calibrator.prior_strength(pairs, batch, last)
    changed = replace(batch, follower_speed=batch.follower_speed.clone())
    changed.follower_speed[:, 201:] += 5.0
    assert calibrator.prior_strength(pairs, changed, last).errors == before.errors
