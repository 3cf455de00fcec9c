"""Who learns from whom."""

from __future__ import annotations

from dataclasses import replace

import torch

from cfx.evaluation.protocols.folds import assign_folds, describe_folds, learned_from
from tests.drives import straight_pairs


def test_nothing_is_learned_from_pairs_that_a_fold_tests_or_whose_driver_it_tests() -> None:
    fold = torch.tensor([0, 0, 1, -1, -2, -3])  # tested in 0 or 1; by nobody; short, of 0 and of 1
    assert learned_from(fold, 2).int().tolist() == [
        [0, 0, 1, 1, 0, 1],
        [1, 1, 0, 1, 1, 0],
        [1, 1, 1, 1, 1, 1],  # the network for drivers of other recordings
    ]


def test_drivers_of_every_fold_are_looked_for_among_leaders() -> None:
    """In each of three folds the driver who is tested leads one who is learned from."""
    pairs = straight_pairs([100, 100, 100])
    chain = []
    for number, pair in enumerate(pairs):
        ids = {"leader_id": str((number + 2) % 3), "follower_id": str(number)}
        chain.append(replace(pair, recording="ring", **ids))
    ring = replace(pairs, pairs=tuple(chain))
    fold = assign_folds(ring, None, "driver", None, seed=0)
    described = describe_folds(ring, fold, "driver")
    assert sorted(fold.tolist()) == [0, 1, 2]
    assert described["test_drivers_who_lead_a_training_pair"] == 3
    assert described["test_pairs_behind_a_training_driver"] == 3
