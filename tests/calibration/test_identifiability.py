"""Slices of the loss and errors on the training part: against the losses that they are made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.identifiability import PLACES, slices, training_errors
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch, PairSet
from cfx.models.krauss import Krauss
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.2, 0.1], [2.0, 0.4], [3.0, 0.8]], dtype=torch.float64)


@pytest.fixture(scope="module")
def pairs() -> PairSet:
    return PairSet(tuple(wavy_pairs(Krauss(), TRUE)), "made up")


@pytest.fixture
def calibrator() -> Calibrator:
    stepper = MemoryStepper(Krauss(), 0.1)
    return Calibrator(Solver(stepper, RandomSearch(), seed=0, memory=1 << 28), cache=Cache(None))


def test_a_slice_is_lowest_at_the_true_parameters(calibrator: Calibrator, pairs: PairSet) -> None:
    batch = PairBatch.of(pairs)
    best = TRUE
    last = batch.lengths - 1
    table = slices(calibrator, batch, last, best, [pair.pair_id for pair in pairs])
    names = calibrator.space.names
    assert len(table) == len(pairs) * len(names) * PLACES
    assert (table["loss"] >= table["best_loss"] - 1e-9).all()
    np.testing.assert_allclose(table["best_loss"], 0, atol=1e-9)
    one = table[(table["pair_id"] == pairs[1].pair_id) & (table["parameter"] == "t_r")]
    spec = next(p for p in calibrator.space if p.name == "t_r")
    assert one["value"].iloc[0] == pytest.approx(spec.low)
    assert one["value"].iloc[-1] == pytest.approx(spec.high)
    # The lowest place is one of the two around the true value.
    near = one.iloc[(one["value"] - best[1, names.index("t_r")].item()).abs().argsort()[:2]]
    assert one.loc[one["loss"].idxmin(), "value"] in set(near["value"])


def test_the_others_are_held(calibrator: Calibrator, pairs: PairSet) -> None:
    batch = PairBatch.of(pairs)
    best = TRUE
    last = batch.lengths - 1
    table = slices(calibrator, batch, last, best, [pair.pair_id for pair in pairs])
    row = table[(table["parameter"] == "t_i") & (table["pair_id"] == pairs[0].pair_id)].iloc[5]
    moved = best[:1].clone()
    moved[0, calibrator.space.names.index("t_i")] = row["value"]
    found = training_errors(calibrator, batch[:1], last[:1], moved)
    assert float(found["rmse_speed"][0]) == pytest.approx(row["loss"], abs=1e-9)


def test_training_errors_are_those_of_the_measured_states(
    calibrator: Calibrator, pairs: PairSet
) -> None:
    batch = PairBatch.of(pairs)
    found = training_errors(calibrator, batch, batch.lengths - 1, TRUE)
    for errors in found.values():
        torch.testing.assert_close(errors, torch.zeros_like(errors), atol=1e-9, rtol=0)


def test_shards_change_nothing(calibrator: Calibrator, pairs: PairSet) -> None:
    batch = PairBatch.of(pairs)
    best = TRUE * 1.1
    ids = [pair.pair_id for pair in pairs]
    whole = slices(calibrator, batch, batch.lengths - 1, best, ids)
    calibrator.solver = replace(calibrator.solver, memory=1)
    parts = slices(calibrator, batch, batch.lengths - 1, best, ids)
    np.testing.assert_allclose(parts["loss"], whole["loss"], rtol=1e-12)
