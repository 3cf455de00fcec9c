"""The contract of a learner, as tests.

Subclass `LearnerContract` and fill in the fixture `learner`; pytest does the rest.
"""

from __future__ import annotations

import pytest

from cfx.learners.base import Learner
from cfx.testing.checks.learners import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class LearnerContract:
    """What every learner must hold: each statement of `cfx.testing.checks.learners` is a test."""

    @pytest.fixture
    def learner(self) -> Learner:
        """Returns the learner under test, with a short training; a module-level one saves time."""
        raise NotImplementedError(
            "the subclass of LearnerContract must define the fixture `learner`"
        )

    @statements(CONTRACT)
    def test_contract(self, check: Check, learner: Learner) -> None:
        hold(check, learner)
