"""The contracts that components of each kind must keep.

`check_contract` is the whole test of a component, with pytest or without:

    def test_contract():
        check_contract(MyModel())

A contract is a module of this package, `cfx_contracts.models` for models and so on; each of its
public functions is a statement, beside the first ones, which cfx itself checks before a job relies
on a component (`cfx.models.contract`). Importing this package imports nothing heavy.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Collection
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from cfx.core import registry
from cfx.core.contract import Check, violations
from cfx.errors import PluginError, nearest


@dataclass(frozen=True)
class Contract:
    """The statements of one kind of component.

    Attributes:
        kind: as in `cfx.get(kind, name)`.
        checks: every statement.
        first: those that take milliseconds; a new component is held to them before a job uses it.
        slow: those that take more than a second or two; `cfx plugins check` leaves them out.
    """

    kind: str
    checks: tuple[Check, ...]
    first: tuple[Check, ...] = ()
    slow: frozenset[Check] = frozenset()

    @property
    def quick(self) -> tuple[Check, ...]:
        """The statements that are checked in a second or two, with default settings."""
        return tuple(check for check in self.checks if check not in self.slow)


def contract_of(
    module: str, kind: str, *, first: Collection[Check] = (), slow: Collection[Check] = ()
) -> Contract:
    """Returns the contract that a module's public functions are.

    Each takes the component first, under the name of its kind.

    Args:
        module: name of the module, which is imported already.
        kind: as in `cfx.get(kind, name)`.
        first: those of the kind's room, which come first (`Contract.first`).
        slow: checks that take long (`Contract.slow`).
    """
    checks = list(first)
    for name, function in vars(sys.modules[module]).items():
        if name.startswith("_") or not inspect.isfunction(function):
            continue
        is_own = function.__module__ == module
        if is_own and next(iter(inspect.signature(function).parameters), "") == kind:
            checks.append(function)
    return Contract(kind, tuple(checks), tuple(first), frozenset(slow))


def contract_for(kind: str) -> Contract:
    """Returns the contract of a kind of component.

    Raises:
        PluginError: there is no such kind.
    """
    if kind not in registry.KINDS:
        raise PluginError(
            f"there is no contract for '{kind}'.{nearest(kind, registry.KINDS)}"
            f" Known: {', '.join(registry.KINDS)}."
        )
    plural = registry.KINDS[kind].entry_points.removeprefix("cfx.")
    contract: Contract = import_module(f"cfx_contracts.{plural}").CONTRACT
    return contract


def check_contract(component: Any, **further: Any) -> None:
    """Holds a component to its contract, whose statements are named in what is raised.

    Args:
        component: with settings that make its work short.
        further: what single statements can be given beside it, by name: a model's `equilibrium`
            (gap at which nothing changes, m, of the common speed, m/s, and the parameters) and
            `leader_deceleration` (m/s2, if it claims to avoid collisions), an optimizer's
            `tolerance` (distance in unit space at which it may end from a known optimum), the
            `model` that a simulator shall drive.

    Raises:
        AssertionError: statements that do not hold: what the contract is and why.
        NotInstalledError: what the component needs to run is not installed.
        TypeError: no statement takes one of `further`.
    """
    broken = list(violations(component, contract_for(component.kind).checks, **further))
    sentences = [f"{name}: {sentence}" for name, sentence in broken]
    if sentences:
        raise AssertionError("\n".join(sentences)) from None
