"""The valid range of networks: what of their training parts is measured."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.learners import base
from cfx.learners.base import TrainingPairs, learned_range
from tests.learners.made import training_data


def test_of_many_pairs_as_many_of_each_network_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = training_data(networks=2)
    rows = torch.tensor([0, 2, 4, 6, 8, 10])  # every second one of each network
    some = replace(
        data,
        pairs=TrainingPairs(
            index=data.pairs.index[rows],
            split=data.pairs.split[rows],
            network=data.pairs.network[rows],
            start=data.pairs.start[rows],
        ),
    )
    monkeypatch.setattr(base, "_PAIRS_AT_MOST", 3)
    found, expected = learned_range(data), learned_range(some)
    assert torch.equal(found.mean, expected.mean)
    assert torch.equal(found.distance, expected.distance)
    monkeypatch.setattr(base, "_PAIRS_AT_MOST", 6)
    assert not torch.equal(learned_range(data).mean, expected.mean)
