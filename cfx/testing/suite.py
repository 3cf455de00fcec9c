"""How a contract becomes pytest's tests: one test per statement.

A test is skipped where the component claims nothing of the kind.
"""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from cfx.testing.contract import Check, Contract, NotApplicable


def statements(contract: Contract) -> pytest.MarkDecorator:
    """Makes a test of every statement; each is named as its function."""
    return pytest.mark.parametrize("check", contract.checks, ids=lambda check: check.__name__)


def hold(check: Check, component: object, **further: Any) -> None:
    """Checks one statement.

    Args:
        check: the statement.
        component: what must hold it.
        further: other arguments by name; the check is given those that it takes.
    """
    wanted = inspect.signature(check).parameters
    given = {name: value for name, value in further.items() if name in wanted}
    try:
        check(component, **given)
    except NotApplicable as reason:
        pytest.skip(str(reason))
