"""The contract of a protocol, as tests.

Subclass `ProtocolContract` and fill in the fixture `protocol`; pytest does the rest.
"""

from __future__ import annotations

import pytest

from cfx.protocols.base import Protocol
from cfx.testing.checks.protocols import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class ProtocolContract:
    """What every protocol must hold: each statement of `cfx.testing.checks.protocols` is a test."""

    @pytest.fixture
    def protocol(self) -> Protocol:
        """Returns the protocol under test; it gets six drivers, each behind their own leader."""
        raise NotImplementedError(
            "the subclass of ProtocolContract must define the fixture `protocol`"
        )

    @statements(CONTRACT)
    def test_contract(self, check: Check, protocol: Protocol) -> None:
        hold(check, protocol)
