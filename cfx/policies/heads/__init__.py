"""Parameter heads: how answers of networks become parameters.

A head is a class and its entry point, of cfx or of another distribution:

    [project.entry-points."cfx.heads"]
    mixture = "my_package.heads:MixtureHead"
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from cfx.core import registry
from cfx.errors import PluginError
from cfx.policies.heads.base import ParameterHead


def head_class(name: str) -> type[ParameterHead]:
    """Imports and returns a head.

    Raises:
        PluginError: there is no such head, or it cannot be imported, or it is no head.
    """
    cls = cast("type[ParameterHead]", registry.get("head", name))
    if cls.name != name:
        raise PluginError(
            f"{registry.entry('head', name)} calls itself '{cls.name}'; its entry point must have"
            " that name"
        )
    return cls


def trained_head(learner: str) -> Callable[[str], str]:
    """Returns the check of a learner's setting `head`: it is one that the learner trains."""

    def check(name: str) -> str:
        trained = [head for head in registry.names("head") if learner in head_class(head).learners]
        if name not in trained:
            raise ValueError(f"should be one of {', '.join(trained)}")
        return name

    return check


def head_name(*, has_base: bool) -> str:
    """Returns the head of a learner's result that names none."""
    if has_base:
        return "offset"
    return "direct"
