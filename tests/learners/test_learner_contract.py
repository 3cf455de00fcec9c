"""Every built-in learner holds the contract."""

from __future__ import annotations

import pytest

from cfx.learners.base import Learner
from cfx.learners.imitation import ImitationLearner
from cfx.learners.rollout import RolloutLearner
from cfx.testing import LearnerContract

# Kept for all tests, which then share a training.
IMITATION = ImitationLearner(epochs=30, learning_rate=0.03)
ROLLOUT = {members: RolloutLearner(**{**RolloutLearner.trial, "members": members}) for members in (1, 2)}


class TestImitation(LearnerContract):
    @pytest.fixture
    def learner(self) -> Learner:
        return IMITATION


@pytest.mark.parametrize("members", ROLLOUT, ids=["one", "committee"], scope="class")
class TestRollout(LearnerContract):
    @pytest.fixture
    def learner(self, members: int) -> Learner:
        return ROLLOUT[members]
