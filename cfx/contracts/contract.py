"""What the checks of every kind share.

Nothing here or in `cfx.contracts` needs pytest.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from cfx.core.errors import NotInstalledError, PluginError

Check = Callable[..., None]
"""Takes a component and checks one statement of its kind's contract.

It raises an AssertionError that says what the contract is and why.
"""


class NotApplicable(Exception):  # noqa: N818 - nothing is wrong: the check has nothing to verify
    """A component does not claim what a check would verify."""


@dataclass(frozen=True)
class Contract:
    """The statements of one kind of component.

    Attributes:
        kind: as in `cfx.get(kind, name)`.
        checks: every statement that needs nothing but the component.
        slow: those of them that take more than a second or two; `quick` leaves them out.
    """

    kind: str
    checks: tuple[Check, ...]
    slow: frozenset[Check] = frozenset()

    @property
    def quick(self) -> tuple[Check, ...]:
        """The statements that are checked in a second or two, with default settings."""
        return tuple(check for check in self.checks if check not in self.slow)


def contract_of(module: str, kind: str, *, slow: Iterable[Check] = ()) -> Contract:
    """Returns the contract that a module's public functions are.

    Each takes the component first, under the name of its kind.

    Args:
        module: name of the module, which is imported already.
        kind: as in `cfx.get(kind, name)`.
        slow: see `Contract`.
    """
    checks = []
    for name, function in vars(sys.modules[module]).items():
        if name.startswith("_") or not inspect.isfunction(function):
            continue
        is_own = function.__module__ == module
        parameters = list(inspect.signature(function).parameters)
        if is_own and parameters and parameters[0] == kind:
            checks.append(function)
    return Contract(kind, tuple(checks), frozenset(slow))


def violations(
    contract: Contract, component: Any, *, quick: bool = True
) -> Iterator[tuple[str, str]]:
    """Checks a component without pytest.

    Yields:
        For each statement that does not hold: the check's name, and what the contract is and why,
        in a sentence or two. A check that ends in another error is reported with it: ordinary input
        must not make a component raise.

    Raises:
        NotInstalledError: what the component needs to run is not installed.
        RuntimeError: Python was started with -O, which removes the assertions that make a check.
    """
    if not __debug__:
        raise RuntimeError(
            "contract checks are made of assertions, which python -O removes;"
            " start python without -O"
        )
    checks = contract.checks
    if quick:
        checks = contract.quick
    for check in checks:
        try:
            check(component)
        except NotApplicable:
            continue
        except NotInstalledError:
            raise
        except (AssertionError, PluginError) as broken:
            yield check.__name__, str(broken)
        except Exception as error:  # a plugin may raise anything
            sentence = f"the component raised {type(error).__name__}: {error}"
            yield check.__name__, sentence.rstrip(": ")
