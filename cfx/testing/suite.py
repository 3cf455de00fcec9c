"""How a contract becomes pytest's tests: one test per statement, skipped where the component claims nothing of the kind."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from cfx.testing.contract import Check, Contract, NotApplicable


def statements(contract: Contract) -> pytest.MarkDecorator:
    """Makes a test of every statement; each is named as its function."""
    return pytest.mark.parametrize("check", contract.checks, ids=lambda check: check.__name__)


def hold(check: Check, component: object, **dataset: Any) -> None:
    """Checks one statement, with what it needs of `material`."""
    wanted = inspect.signature(check).parameters
    try:
        check(component, **{name: value for name, value in dataset.items() if name in wanted})
    except NotApplicable as reason:
        pytest.skip(str(reason))
