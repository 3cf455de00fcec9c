"""The contract of an optimizer, as tests.

Subclass `OptimizerContract`, fill in the fixture `optimizer`, and pytest does the rest.
"""

from __future__ import annotations

from typing import ClassVar

import pytest

from cfx.optimizers.base import Optimizer
from cfx.testing.checks.optimizers import CONTRACT, TOLERANCE, Function, Problems, bowl, distance
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements

__all__ = ["Function", "OptimizerContract", "Problems", "bowl", "distance"]


class OptimizerContract:
    """What every optimizer must hold: each statement of `cfx.testing.checks.optimizers` is a test.

    Attributes:
        tolerance: how far in unit space from a known optimum of two parameters the optimizer may
            end.
    """

    tolerance: ClassVar[float] = TOLERANCE

    @pytest.fixture
    def optimizer(self) -> Optimizer:
        """Returns the optimizer under test; choose few evaluations: it runs some fifty times."""
        raise NotImplementedError(
            "the subclass of OptimizerContract must define the fixture `optimizer`"
        )

    @statements(CONTRACT)
    def test_contract(self, check: Check, optimizer: Optimizer) -> None:
        hold(check, optimizer, tolerance=self.tolerance)
