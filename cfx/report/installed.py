"""What distributions bring to reports by entry points: figures and sections.

Each is a class without settings. Its entry point, in the group of its base class, names it:

    [project.entry-points."cfx.figures"]
    speed_histogram = "my_package.figures:SpeedHistogram"

    [project.entry-points."cfx.sections"]
    weather = "my_package.sections:Weather"
"""

from __future__ import annotations

import importlib.metadata
import logging
from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Generic, Self, TypeVar

from cfx.core.errors import PluginError
from cfx.core.registry import OWN

log = logging.getLogger(__name__)


class Part(ABC):
    """Base of what a distribution brings.

    Attributes:
        kind: what messages call it; the base class of each kind sets it, as it does `group` and
            `required`.
        group: its entry-point group.
        required: attributes that each class must set.
        title: what it shows, in a few words.
        order: its place among its kind; smaller numbers come first.
    """

    kind: ClassVar[str]
    group: ClassVar[str]
    required: ClassVar[tuple[str, ...]]
    title: ClassVar[str]
    order: ClassVar[int] = 1000

    @classmethod
    def installed(cls) -> tuple[Installed[Self], ...]:
        """Return all of this kind, in their order.

        One of another distribution never replaces cfx's own. One that cannot be imported, or breaks
        the contract, is left out with a warning.
        """
        return _installed(cls)

    @classmethod
    def named(cls, name: str) -> Installed[Self]:
        """Return the one of a name.

        Raises:
            PluginError: there is none.
        """
        for one in cls.installed():
            if one.name == name:
                return one
        known = ", ".join(one.name for one in cls.installed())
        raise PluginError(f"there is no {cls.kind} '{name}'. Known: {known}.")


P = TypeVar("P", bound=Part)
R = TypeVar("R")


@dataclass(frozen=True)
class Installed(Generic[P]):
    """A figure or a section, and who brings it.

    Attributes:
        name: of its entry point.
        part: the figure or section.
        distribution: who brings it.
    """

    name: str
    part: P
    distribution: str

    def attempt(self, work: Callable[[P], R]) -> R | None:
        """Return what `work` makes of it.

        One of another distribution that fails is left out with a warning, and None is returned:
        the job has its results.
        """
        try:
            return work(self.part)
        except Exception as error:
            if self.distribution == OWN:
                raise
            _warn(self.part.kind, self.name, self.distribution, f"{type(error).__name__}: {error}")
            return None


@cache
def _installed(base: type[Part]) -> tuple[Installed[Any], ...]:
    found: dict[str, Installed[Any]] = {}
    entries = importlib.metadata.entry_points(group=base.group)
    for entry in sorted(entries, key=lambda one: (_distribution(one) != OWN, one.name)):
        distribution = _distribution(entry)
        if entry.name in found:
            if distribution != found[entry.name].distribution:
                _warn(base.kind, entry.name, distribution, "another brings one of that name")
            continue
        try:
            part = _make(entry, base)
        except Exception as error:
            if distribution == OWN:
                raise
            _warn(base.kind, entry.name, distribution, str(error))
            continue
        found[entry.name] = Installed(entry.name, part, distribution)
    return tuple(sorted(found.values(), key=lambda one: (one.part.order, one.name)))


def _make(entry: importlib.metadata.EntryPoint, base: type[Part]) -> Part:
    cls = entry.load()
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise PluginError(
            f"{entry.value} is no class that extends {base.__module__}.{base.__name__}"
        )
    for attribute in base.required:
        if not getattr(cls, attribute, ""):
            raise PluginError(f"{entry.value} has no {attribute}; give it one")
    made: Part = cls()
    return made


def _warn(kind: str, name: str, distribution: str, reason: str) -> None:
    log.warning(
        "%s %s of the distribution %s is left out: %s; repair or uninstall it",
        kind,
        name,
        distribution,
        reason,
    )


def _distribution(entry: importlib.metadata.EntryPoint) -> str:
    return "" if entry.dist is None else entry.dist.name
