"""The contract of a policy, as tests.

Subclass `PolicyContract` and fill in the fixture `policy`; pytest does the rest.
"""

from __future__ import annotations

import pytest

from cfx.policies.base import Policy
from cfx.testing.checks.policies import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class PolicyContract:
    """What every policy must hold: each statement of `cfx.testing.checks.policies` is a test."""

    @pytest.fixture
    def policy(self) -> Policy:
        """Returns the policy under test."""
        raise NotImplementedError("the subclass of PolicyContract must define the fixture `policy`")

    @statements(CONTRACT)
    def test_contract(self, check: Check, policy: Policy) -> None:
        hold(check, policy)
