"""What the posterior says of a driver whose parameters are known."""

import cfx
import numpy as np
import pytest
import torch
from cfx.plugin import CalibrationSettings, MemoryStepper, PairBatch, Solver

from cfx_example.posterior import KEPT, AbcRejection

MODEL = cfx.get("model", "idm")()


@pytest.fixture(scope="module")
def found():
    """Recordings of drivers of the same model."""
    pairs = cfx.get("dataset", "synthetic")(model="idm", pairs=2, frames=300).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(MODEL, batch.dt), cfx.get("optimizer", "random")(), seed=0)
    last = batch.lengths - 1
    best = MODEL.space.defaults(dtype=torch.float64).expand(2, -1)
    return AbcRejection().find(solver, batch, last, best, CalibrationSettings())


def test_cfx_finds_it():
    found = cfx.get("posterior", "abc_rejection")
    assert found is AbcRejection, "install it first: pip install --editable ."


def test_draws_lie_within_the_bounds(found):
    low, high = MODEL.space.bounds()
    assert found.draws.shape == (2, KEPT, len(MODEL.space))
    assert bool(((found.draws >= low) & (found.draws <= high)).all())


def test_intervals_are_in_order_and_narrower_than_the_prior(found):
    columns = found.columns()
    for name in MODEL.space.names:
        assert (columns[f"low_{name}"] < columns[f"median_{name}"]).all()
        assert (columns[f"median_{name}"] < columns[f"high_{name}"]).all()
    contraction = np.mean([columns[f"contraction_{name}"] for name in MODEL.space.names])
    assert contraction > 0.1, "the recordings say something"


def test_the_same_seed_draws_the_same_drivers(found):
    torch.testing.assert_close(found.draw_drivers(5, 1), found.draw_drivers(5, 1))
