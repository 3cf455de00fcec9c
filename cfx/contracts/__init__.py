"""The contracts that components of each kind must keep.

`check_contract` is the whole test of a component, with pytest or without:

    def test_contract():
        check_contract(MyModel())

A contract is a module of this package, `cfx.contracts.models` for models and so on; each of its
public functions is a statement. Importing this package imports nothing heavy.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from cfx.core import registry
from cfx.core.errors import NotInstalledError, PluginError, nearest

T = TypeVar("T")

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
        first: checks that come first (`Contract.first`).
        slow: checks that take long (`Contract.slow`).
    """
    checks = []
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
    found: Contract = import_module(f"cfx.contracts.{plural}").CONTRACT
    return found


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
    broken = list(violations(component, **further))
    sentences = [f"{name}: {sentence}" for name, sentence in broken]
    if sentences:
        raise AssertionError("\n".join(sentences)) from None


def violations(
    component: Any, checks: Collection[Check] | None = None, **further: Any
) -> Iterator[tuple[str, str]]:
    """Checks a component.

    Args:
        component: what must keep the contract of its kind.
        checks: the statements; by default all.
        further: see `check_contract`.

    Yields:
        For each statement that does not hold: the check's name, and what the contract is and why,
        in a sentence or two. A check that ends in another error is reported with it: ordinary input
        must not make a component raise.

    Raises:
        NotInstalledError: what the component needs to run is not installed.
        RuntimeError: Python was started with -O, which removes the assertions that make a check.
        TypeError: no statement takes one of `further`.
    """
    if not __debug__:
        raise RuntimeError(
            "contract checks are made of assertions, which python -O removes;"
            " start python without -O"
        )
    if checks is None:
        checks = contract_for(component.kind).checks
    wanted = {check: inspect.signature(check).parameters for check in checks}
    unknown = sorted(
        name for name in further if not any(name in taken for taken in wanted.values())
    )
    if unknown:
        raise TypeError(f"no statement of this contract takes {', '.join(unknown)}")
    for check, taken in wanted.items():
        given = {name: value for name, value in further.items() if name in taken}
        try:
            check(component, **given)
        except NotApplicable:
            continue
        except NotInstalledError:
            raise
        except (AssertionError, PluginError) as broken:
            yield check.__name__, str(broken)
        except Exception as error:  # a plugin may raise anything
            yield check.__name__, f"the component raised {registry.in_words(error)}"


_made: WeakKeyDictionary[Any, dict[object, Any]] = WeakKeyDictionary()


def once(component: object, key: object, make: Callable[[], T]) -> T:
    """Returns what `make` gives, which is asked once for all checks of one component."""
    known = _made.setdefault(component, {})
    if key not in known:
        known[key] = make()
    found: T = known[key]
    return found


def expect_tensor(
    value: Any, what: str, shape: tuple[int, ...], dtype: Any, shape_in_words: str
) -> None:
    """Asserts that a component gives a tensor of a shape and a dtype."""
    import torch

    given = f"a {type(value).__name__}"
    if isinstance(value, torch.Tensor):
        given = f"the shape {tuple(value.shape)}"
    assert isinstance(value, torch.Tensor) and value.shape == shape, (  # noqa: PT018 - one sentence
        f"{what} gives {given}; it must give {shape_in_words}, here {shape}"
    )
    assert value.dtype == dtype, (
        f"{what} gives {value.dtype} for {dtype}; a component computes in the dtype of what it is"
        " given"
    )


def expect_close(
    value: Any,
    expected: Any,
    *,
    msg: str,
    rtol: float | None = None,
    atol: float | None = None,
    equal_nan: bool = False,
) -> None:
    """Asserts that two tensors agree in shape, dtype and numbers.

    As `torch.testing.assert_close`, with its tolerances, which would import PyTorch's distributed
    tensors and SymPy: a second of the start of every job.

    Args:
        value: what a component gives.
        expected: what it must give.
        msg: the sentence that says so.
        rtol: largest relative difference; None: PyTorch's for the dtype.
        atol: largest absolute difference; None: PyTorch's for the dtype.
        equal_nan: whether NaN agrees with NaN.
    """
    import torch

    alike = value.shape == expected.shape and value.dtype == expected.dtype
    usual = (1.3e-6, 1e-5) if value.dtype == torch.float32 else (1e-7, 1e-7)
    assert alike and torch.allclose(  # noqa: PT018 - one sentence
        value,
        expected,
        rtol=usual[0] if rtol is None else rtol,
        atol=usual[1] if atol is None else atol,
        equal_nan=equal_nan,
    ), msg
