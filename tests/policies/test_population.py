"""The drivers whom a policy learned from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from cfx.policies import checkpoint
from cfx.policies.agent import TrainedOn
from cfx.policies.population import DriverPopulation
from tests.agents import adaptive
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.1], [3.0, 0.1]]).double()
FEATURES = ("time_headway", "acceleration")


def test_each_driver_counts_once() -> None:
    """Two drivers of three pairs; those measured for less than 15 s are nobody's driver."""
    batch = PairBatch.of(wavy_pairs(Krauss(), TRUE, frames=260))
    found = DriverPopulation.of(batch, FEATURES, ["a", "a", "b"])
    assert found is not None
    assert found.weight.tolist() == pytest.approx([0.25, 0.25, 0.5])
    assert bool((found.features[:, 0].diff() > 0).all()), "time headways in order of t_r"
    drawn = found.drawn(torch.tensor([0.0, 0.2, 0.3, 0.6, 0.999]))
    assert torch.equal(drawn, found.features[[0, 0, 1, 2, 2]])
    assert DriverPopulation.of(batch, (), ["a", "a", "b"]) is None
    short = PairBatch.of(wavy_pairs(Krauss(), TRUE, frames=100))
    assert DriverPopulation.of(short, FEATURES, ["a", "a", "b"]) is None


def test_it_is_saved_with_the_policy(tmp_path: Path) -> None:
    drivers = DriverPopulation(torch.tensor([[0.1, 2.0], [0.4, 1.0]]).double(), torch.ones(2) / 2)
    agent = adaptive({"name": "krauss"}, driver_features=FEATURES)
    checkpoint.save_agent(replace(agent, trained_on=TrainedOn(drivers=drivers)), tmp_path)
    loaded = checkpoint.load_agent(tmp_path).trained_on.drivers
    assert loaded is not None
    assert torch.equal(loaded.features, drivers.features)
    assert torch.equal(loaded.weight, drivers.weight)
    other = drivers._replace(features=drivers.features[:, :1])
    checkpoint.save_agent(replace(agent, trained_on=TrainedOn(drivers=other)), tmp_path)
    with pytest.raises(DataError, match=r"drivers\.features"):
        checkpoint.load_agent(tmp_path)
