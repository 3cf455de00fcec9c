"""The contract of a driving model, as tests.

Subclass `ModelContract` and fill in the fixture `model`; pytest does the rest.

Example, the whole test module of a plugin:

    class TestMine(ModelContract):
        @pytest.fixture
        def model(self):
            return MyModel()
"""

from __future__ import annotations

import pytest

from cfx.models.base import DrivingModel
from cfx.testing.checks.models import CONTRACT, Equilibrium
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements

__all__ = ["Equilibrium", "ModelContract"]


class ModelContract:
    """What every model must hold: each statement of `cfx.testing.checks.models` is a test."""

    @pytest.fixture
    def model(self) -> DrivingModel:
        """Returns the model under test."""
        raise NotImplementedError("the subclass of ModelContract must define the fixture `model`")

    @pytest.fixture
    def equilibrium(self) -> Equilibrium | None:
        """Returns the closed form of the equilibrium gap, where the model has one."""
        return None

    @pytest.fixture
    def leader_deceleration(self) -> float:
        """Returns how hard the leader brakes, m/s2, if the model claims to avoid collisions."""
        return 4.5

    @statements(CONTRACT)
    def test_contract(
        self,
        check: Check,
        model: DrivingModel,
        equilibrium: Equilibrium | None,
        leader_deceleration: float,
    ) -> None:
        hold(check, model, equilibrium=equilibrium, leader_deceleration=leader_deceleration)
