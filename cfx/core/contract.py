"""What a contract is made of: statements about a component, each a function that asserts it.

The first statements of a kind's contract stand in its room (`cfx.models.contract` for models): a
job holds a new component to them before it relies on it. The whole contract is cfx-contracts'.
Importing this module imports nothing heavy.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from cfx.errors import NotInstalledError, PluginError, in_words

T = TypeVar("T")


Check = Callable[..., None]
"""Takes a component and checks one statement of its kind's contract.

It raises an AssertionError that says what the contract is and why.
"""


class NotApplicable(Exception):  # noqa: N818 - nothing is wrong: the check has nothing to verify
    """A component does not claim what a check would verify."""


def violations(
    component: Any, checks: Collection[Check], **further: Any
) -> Iterator[tuple[str, str]]:
    """Checks a component.

    Args:
        component: what must keep the contract of its kind.
        checks: the statements, functions that take the component.
        further: what single statements can be given beside it, by name.

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
    unknown = set(further)
    arguments = {}
    for check in checks:
        parameters = inspect.signature(check).parameters.keys()
        arguments[check] = {name: further[name] for name in parameters & further.keys()}
        unknown -= parameters
    if unknown:
        raise TypeError(f"no statement of this contract takes {', '.join(sorted(unknown))}")
    for check, values in arguments.items():
        try:
            check(component, **values)
        except NotApplicable:
            continue
        except NotInstalledError:
            raise
        except (AssertionError, PluginError) as broken:
            yield check.__name__, str(broken)
        except Exception as error:  # a plugin may raise anything
            yield check.__name__, f"the component raised {in_words(error)}"


_made: WeakKeyDictionary[Any, dict[object, Any]] = WeakKeyDictionary()


def once(component: object, key: object, make: Callable[[], T]) -> T:
    """Returns what `make` gives, which is asked once for all checks of one component."""
    made = _made.setdefault(component, {})
    if key not in made:
        made[key] = make()
    value: T = made[key]
    return value


def expect_tensor(
    value: Any, what: str, shape: tuple[int, ...], dtype: Any, shape_in_words: str
) -> None:
    """Asserts that a component gives a tensor of a shape and a dtype."""
    import torch

    delivered = f"a {type(value).__name__}"
    if isinstance(value, torch.Tensor):
        delivered = f"the shape {tuple(value.shape)}"
    assert isinstance(value, torch.Tensor) and value.shape == shape, (  # noqa: PT018 - one sentence
        f"{what} gives {delivered}; it must give {shape_in_words}, here {shape}"
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
