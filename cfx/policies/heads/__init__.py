"""Parameter heads: how answers of networks become parameters.

A head is a class and its entry point, of cfx or of another distribution:

    [project.entry-points."cfx.heads"]
    mixture = "my_package.heads:MixtureHead"
"""

from __future__ import annotations

import functools
import importlib.metadata
from collections.abc import Callable

from cfx.core.errors import PluginError
from cfx.core.registry import OWN
from cfx.policies.heads.base import ParameterHead


@functools.cache
def _announced() -> dict[str, importlib.metadata.EntryPoint]:
    """Returns the entry points by name; a name of cfx's own always means cfx's own."""
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for entry in importlib.metadata.entry_points(group="cfx.heads"):
        if entry.name not in found or (entry.dist is not None and entry.dist.name == OWN):
            found[entry.name] = entry
    return dict(sorted(found.items()))


def head_names() -> tuple[str, ...]:
    """Returns the names of all installed heads, which saved policies give. Imports none."""
    return tuple(_announced())


@functools.cache
def head_class(name: str) -> type[ParameterHead]:
    """Imports and returns a head.

    Raises:
        PluginError: there is no such head, or it cannot be imported, or it is no head.
    """
    if name not in _announced():
        raise PluginError(f"there is no head '{name}'; write one of {', '.join(head_names())}")
    entry = _announced()[name]
    whose = f"the head '{name}' ({entry.value})"
    try:
        cls = entry.load()
    except Exception as error:  # a plugin may raise anything
        raise PluginError(
            f"{whose} cannot be imported: {type(error).__name__}: {error}; repair its distribution"
        ) from error
    if not (isinstance(cls, type) and issubclass(cls, ParameterHead)):
        raise PluginError(f"{whose} does not extend cfx.policies.heads.base.ParameterHead")
    if cls.name != name:
        raise PluginError(f"{whose} calls itself '{cls.name}'; its entry point must have that name")
    return cls


def trained_head(learner: str) -> Callable[[str], str]:
    """Returns the check of a learner's setting `head`: it is one that the learner trains."""

    def check(name: str) -> str:
        known = [one for one in head_names() if learner in head_class(one).learners]
        if name not in known:
            raise ValueError(f"should be one of {', '.join(known)}")
        return name

    return check


def head_name(*, has_base: bool) -> str:
    """Returns the head of a learner's result that names none."""
    if has_base:
        return "offset"
    return "direct"
