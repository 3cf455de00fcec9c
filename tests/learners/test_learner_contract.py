"""Every built-in learner holds the contract."""

from __future__ import annotations

import pytest

from cfx.contracts import LearnerContract
from cfx.learners.base import Learner
from cfx.learners.imitation import ImitationLearner
from cfx.learners.rollout import RolloutLearner

# Kept for all tests, which then share a training.
IMITATION = {
    "direct": ImitationLearner(epochs=30, learning_rate=0.03),
    "offset": ImitationLearner(epochs=30, learning_rate=0.03, head="offset"),
}
_TRIAL = dict(RolloutLearner.trial)
ROLLOUT = {
    "ensemble": RolloutLearner(**(_TRIAL | {"ensemble_size": 2})),
    "distillation": RolloutLearner(**(_TRIAL | {"ensemble_size": 1, "distillation_epochs": 2})),
}


@pytest.mark.parametrize("name", IMITATION, scope="class")
class TestImitation(LearnerContract):
    @pytest.fixture
    def learner(self, name: str) -> Learner:
        return IMITATION[name]


@pytest.mark.parametrize("name", ROLLOUT, scope="class")
class TestRollout(LearnerContract):
    @pytest.fixture
    def learner(self, name: str) -> Learner:
        return ROLLOUT[name]
