"""The contract of an objective, as tests.

Subclass `ObjectiveContract`, fill in the fixture `objective`, and pytest does the rest.
"""

from __future__ import annotations

import pytest

from cfx.objectives.base import Objective
from cfx.testing.checks.objectives import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class ObjectiveContract:
    """What every objective must hold; `cfx.testing.checks.objectives` has the statements."""

    @pytest.fixture
    def objective(self) -> Objective:
        """Returns the objective under test."""
        raise NotImplementedError(
            "the subclass of ObjectiveContract must define the fixture `objective`"
        )

    @statements(CONTRACT)
    def test_contract(self, check: Check, objective: Objective) -> None:
        hold(check, objective)
