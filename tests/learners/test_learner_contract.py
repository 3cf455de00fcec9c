"""Every built-in learner holds the contract."""

from __future__ import annotations

import pytest

from cfx.learners.base import Learner
from cfx.learners.imitation import ImitationLearner
from cfx.testing import LearnerContract

IMITATION = ImitationLearner(epochs=30, learning_rate=0.03)  # kept for all tests, which then share a training


class TestImitation(LearnerContract):
    @pytest.fixture
    def learner(self) -> Learner:
        return IMITATION
