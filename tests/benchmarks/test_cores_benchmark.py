"""Training on all cores beside training on one, in the same run; the results are the same bits.

`extra_info` holds the ratio of their times, compiled code being there for both; nothing passes or
fails by the clock.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
import torch

from cfx.core.threads import cores, limit_cores
from cfx.learners.base import TrainingResult
from cfx.learners.rollout import RolloutLearner
from cfx.models.krauss import Krauss
from cfx.policies.gru import GruPolicy
from tests.benchmarks.test_rollout_learning_benchmark import POLICY, _training_data

NETWORKS, EPOCHS = 6, 12


def _trained(count: int | None, epochs: int) -> tuple[TrainingResult, float]:
    """Trains 24 networks; returns what came of it, and the seconds that it took."""
    model = Krauss()
    data = replace(_training_data(model, NETWORKS), workspace=None)
    policy = GruPolicy(inputs=POLICY.inputs, hidden_size=64)
    learner = RolloutLearner(draws=4, horizon=20, epochs=epochs, patience=None, compile="always")
    limit_cores(count)
    try:
        began = time.perf_counter()
        result = learner.fit(policy, data)
        return result, time.perf_counter() - began
    finally:
        limit_cores(None)


@pytest.mark.benchmark(group="training")
@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
def test_training_on_all_cores(benchmark: Any) -> None:
    _trained(1, 4)  # compiles
    one, alone = _trained(1, EPOCHS)
    shared, together = benchmark.pedantic(_trained, args=(None, EPOCHS), rounds=1)
    benchmark.extra_info["cores"] = cores()
    benchmark.extra_info["times faster than one core"] = alone / together
    benchmark.extra_info["seconds on one core"] = alone
    weights = shared.network.state_dict()
    for name, value in one.network.state_dict().items():
        assert torch.equal(weights[name], value)
