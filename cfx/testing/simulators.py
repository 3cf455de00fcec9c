"""The contract of a simulator, as tests: subclass `SimulatorContract` and fill in the fixture."""

from __future__ import annotations

import pytest

from cfx.models.base import DrivingModel
from cfx.simulators.base import Simulator
from cfx.testing.checks.simulators import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements

__all__ = ["SimulatorContract"]


class SimulatorContract:
    """What every simulator must hold: a test for each check in `cfx.testing.checks.simulators`."""

    @pytest.fixture
    def simulator(self) -> Simulator:
        """Returns the simulator under test."""
        raise NotImplementedError(
            "the subclass of SimulatorContract must define the fixture `simulator`"
        )

    @pytest.fixture
    def model(self) -> DrivingModel | None:
        """Returns the model to drive; None: the first of cfx's own that the simulator can drive."""
        return None

    @statements(CONTRACT)
    def test_contract(self, check: Check, simulator: Simulator, model: DrivingModel | None) -> None:
        hold(check, simulator, model=model)
