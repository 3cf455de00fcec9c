"""The contract of an engine, as tests: subclass `EngineContract` and fill in the fixture."""

from __future__ import annotations

import pytest

from cfx.engine.base import Engine
from cfx.testing.checks.engines import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements

__all__ = ["EngineContract"]


class EngineContract:
    """What every engine must hold: a test for each check in `cfx.testing.checks.engines`."""

    @pytest.fixture
    def engine(self) -> Engine:
        """Returns the engine under test."""
        raise NotImplementedError("the subclass of EngineContract must define the fixture `engine`")

    @statements(CONTRACT)
    def test_contract(self, check: Check, engine: Engine) -> None:
        hold(check, engine)
