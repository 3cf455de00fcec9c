"""Which trajectories a gradient step and a validation take."""

from __future__ import annotations

import torch

from cfx.learners.rollout.dataset import RolloutBatch
from tests.learners.made import TRUE, module_of, training_data


def test_of_many_drivers_some_are_in_each_step() -> None:
    """Others in each step, and all of them in the end; some are validated, the same ones always."""
    data = training_data(base=TRUE.repeat(2, 1))
    module = module_of(data, drivers=2, draws=3, validation=0.5)
    dataset, sampler = module.dataset, module.sampler
    batches = [sampler.training(step) for step in range(12)]
    for batch in batches:
        assert batch.place.shape == (2, 6)
        assert bool((batch.weight == 1).all())
    validated = sampler.validation_places
    for network in range(2):
        seen = set()
        for batch in batches:
            seen.update(batch.place[network].tolist())
        assert seen == set(dataset.trains[network].nonzero()[:, 0].tolist())
        assert len(set(validated[network].tolist())) == 2
        assert bool(dataset.validates[network, validated[network]].all())
    assert torch.equal(sampler.training(3).place, batches[3].place)
    everybody = module_of(data, drivers=6, draws=1, validation=0.5).sampler.training(0)
    for network in range(2):
        trained_on = dataset.trains[network].nonzero()[:, 0].tolist()
        assert everybody.place[network].tolist() == trained_on
    assert bool((everybody.weight == 1).all())


def test_trajectories_without_weight_are_not_simulated() -> None:
    """Unless another network has more with weight."""
    data = training_data(base=TRUE.repeat(2, 1), drivers=tuple("abcdefaabcde"))
    module = module_of(data, validation=0.3)
    counts = module.dataset.trains.sum(1).tolist()
    assert counts[0] != counts[1]
    batch = module.sampler.training(7)
    assert batch.place.shape == (2, max(counts) * module.settings.draws)
    assert (batch.weight.sum(1) / module.settings.draws).tolist() == counts
    assert batch.scale is not None


def test_trajectories_with_weight_keep_their_order() -> None:
    number = torch.arange(8).view(2, 4)
    weight = torch.tensor([[1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    made = RolloutBatch(number, number + 10, number > 3, number + 30, weight)
    kept = made.without_unweighted()
    assert kept.weight.tolist() == [[1.0, 1.0], [0.0, 1.0]]
    assert kept.place.tolist() == [[0, 2], [4, 6]]
    assert kept.start.tolist() == [[10, 12], [14, 16]]
    assert kept.cold_start.tolist() == [[False, False], [True, True]]
    assert kept.last.tolist() == [[30, 32], [34, 36]]
    assert kept.scale is None
