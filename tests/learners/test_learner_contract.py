"""Every built-in learner holds the contract."""

from __future__ import annotations

import pytest

from cfx.learners.base import Learner
from cfx.learners.imitation import ImitationLearner
from cfx.learners.rollout import RolloutLearner
from cfx.testing import LearnerContract

# Kept for all tests, which then share a training.
IMITATION = ImitationLearner(epochs=30, learning_rate=0.03)
ROLLOUT = {
    name: RolloutLearner(**{**RolloutLearner.trial, **options})
    for name, options in {
        "one": {"ensemble_size": 1},
        "ensemble": {"ensemble_size": 2},
        "distillation_epochs": {"ensemble_size": 1, "distillation_epochs": 2},
    }.items()
}


class TestImitation(LearnerContract):
    @pytest.fixture
    def learner(self) -> Learner:
        return IMITATION


@pytest.mark.parametrize("name", ROLLOUT, scope="class")
class TestRollout(LearnerContract):
    @pytest.fixture
    def learner(self, name: str) -> Learner:
        return ROLLOUT[name]
