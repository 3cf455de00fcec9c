"""One lazy registry for every kind of component; built-in and third-party components come in by the same entry points.

`names` and `entries` read the metadata of installed distributions and import nothing. `get` imports the one component that is
asked for, checks it, and only then keeps it. A broken plugin therefore never harms a run that does not name it.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cfx.component import Component, Settings, validate
from cfx.errors import ConfigError, PluginError, nearest


@dataclass(frozen=True)
class Kind:
    """A kind of component.

    Attributes:
        name: as in `cfx.get(kind, name)`.
        group: its config group, the folder in `conf/` and the key in configs.
        entry_points: its entry-point group.
        base: module and class that its components extend.
    """

    name: str
    group: str
    entry_points: str
    base: str


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("dataset", "data", "cfx.datasets", "cfx.datasets.base:Dataset"),
        Kind("model", "model", "cfx.models", "cfx.models.base:DrivingModel"),
        Kind("policy", "policy", "cfx.policies", "cfx.policies.base:Policy"),
        Kind("optimizer", "optimizer", "cfx.optimizers", "cfx.optimizers.base:Optimizer"),
        Kind("learner", "learner", "cfx.learners", "cfx.learners.base:Learner"),
        Kind("protocol", "protocol", "cfx.protocols", "cfx.protocols.base:Protocol"),
    )
}

GROUPS: dict[str, Kind] = {kind.group: kind for kind in KINDS.values()}
"""Kinds by config group."""


@dataclass(frozen=True)
class Entry:
    """One component as its distribution's metadata announces it.

    Attributes:
        kind, name: how it is asked for.
        target: `module:Class`.
        distribution, version: who brings it.
        location: folder that the distribution's metadata lies in.
    """

    kind: str
    name: str
    target: str
    distribution: str
    version: str
    location: str

    @property
    def package(self) -> str:
        """Top-level package of the class."""
        return self.target.partition(":")[0].partition(".")[0]

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}' ({self.target}) of the distribution {self.distribution} {self.version}"


_loaded: dict[Entry, type[Component]] = {}


def kind_of(kind: str) -> Kind:
    """Returns a kind by its name or by its config group (`dataset` or `data`).

    Raises:
        PluginError: there is no such kind.
    """
    found = KINDS.get(kind) or GROUPS.get(kind)
    if found is None:
        raise PluginError(f"there is no kind of component '{kind}'.{nearest(kind, KINDS)} Known: {', '.join(KINDS)}.")
    return found


def entries(kind: str) -> tuple[Entry, ...]:
    """Returns what the installed distributions announce, sorted by name; two entries may share a name. Imports nothing.

    Raises:
        PluginError: there is no such kind.
    """
    return _announced(_search_path())[kind_of(kind).name]


def names(kind: str) -> tuple[str, ...]:
    """Returns the names of all components of a kind, sorted. Imports nothing."""
    return tuple(sorted({entry.name for entry in entries(kind)}))


def entry(kind: str, name: str) -> Entry:
    """Returns the one entry of that name. Imports nothing.

    Raises:
        PluginError: the name is unknown, or two distributions claim it.
    """
    group = kind_of(kind).group
    found = [candidate for candidate in entries(kind) if candidate.name == name]
    if not found:
        known = names(kind)
        if not known:
            raise PluginError(f"{group}={name}: no {kind} is installed, not even cfx's own; run make run, or pip install -e .")
        raise PluginError(f"{group}={name}: there is no {kind} '{name}'.{nearest(name, known)} Known: {', '.join(known)}.")
    if len(found) > 1:
        claims = " and ".join(f"{one.distribution} {one.version} ({one.target})" for one in found)
        raise PluginError(f"{group}={name}: two distributions bring a {kind} '{name}': {claims}; uninstall one of them")
    return found[0]


def get(kind: str, name: str) -> type[Component]:
    """Imports, checks and returns a component's class.

    Raises:
        PluginError: the name is unknown or claimed twice; or the component cannot be imported or breaks the contract of its kind.
    """
    found = entry(kind, name)
    if found not in _loaded:
        cls = _import(found)
        _check(found, cls)
        _loaded[found] = cls
    return _loaded[found]


def create(kind: str, node: Mapping[str, Any]) -> Component:
    """Creates a component from its config node: `name` and its settings.

    Raises:
        PluginError: as `get`.
        ConfigError: the node has no name, an unknown key or a wrong value.
        ParameterError: a model's parameters contradict each other.
    """
    group = kind_of(kind).group
    if not isinstance(node, Mapping):
        raise ConfigError(f"{group}={node!r}: choose a {kind} by its name; known: {', '.join(names(kind))}")
    name = node.get("name")
    if not isinstance(name, str):
        raise ConfigError(f"{group}.name: a value is required; choose a {kind}: {', '.join(names(kind))}")
    cls = get(kind, name)
    values = {key: value for key, value in node.items() if key != "name"}
    return cls(validate(cls.schema, _without_blanks(cls.schema, values), where=group))


def is_loaded(found: Entry) -> bool:
    """Says whether the component was imported and passed its checks."""
    return found in _loaded


def _search_path() -> tuple[tuple[str, float], ...]:
    """Returns what changes when a distribution is installed, so that a new plugin is seen without a restart."""
    return tuple((folder, Path(folder).stat().st_mtime) for folder in sys.path if folder and Path(folder).exists())


@functools.lru_cache(maxsize=1)
def _announced(search_path: tuple[tuple[str, float], ...]) -> dict[str, tuple[Entry, ...]]:  # noqa: ARG001 - the cache's key
    points = importlib.metadata.entry_points()
    return {name: tuple(sorted(_entries(kind, points), key=attrgetter("name", "distribution"))) for name, kind in KINDS.items()}


def _entries(kind: Kind, points: Any) -> list[Entry]:
    found = []
    for point in points.select(group=kind.entry_points):
        distribution = point.dist
        if distribution is None:  # an entry point read from a bare file; importlib.metadata always knows the distribution
            continue
        location = str(distribution.locate_file(""))
        found.append(Entry(kind.name, point.name, point.value, distribution.name, distribution.version, location))
    return found


def _import(found: Entry) -> Any:
    module, _, attribute = found.target.partition(":")
    try:
        return functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a plugin may raise anything, even SystemExit
        what = f"{type(error).__name__}: {error}".rstrip(": ")
        raise PluginError(
            f"{found} cannot be imported: {what}; repair that distribution, or pip uninstall {found.distribution}"
        ) from error


def _check(found: Entry, cls: Any) -> None:
    """Raises PluginError unless `cls` keeps the contract of its kind."""
    base = _base(KINDS[found.kind])
    if not inspect.isclass(cls):
        raise PluginError(f"{found} is no class but {type(cls).__name__}; point its entry point at a subclass of {base.__name__}")
    if not issubclass(cls, Component) or not issubclass(cls, base):
        raise PluginError(f"{found} does not extend {base.__module__}.{base.__name__}")
    if cls.kind != base.kind:
        raise PluginError(f"{found} says kind='{cls.kind}', but a {found.kind} keeps kind='{base.kind}' of its base class")
    missing = sorted(getattr(cls, "__abstractmethods__", ()) or _unimplemented(cls))
    if missing:
        raise PluginError(f"{found} does not implement {', '.join(missing)}")
    schema = cls.schema
    if not (inspect.isclass(schema) and issubclass(schema, Settings)):
        raise PluginError(f"{found}: its schema must be a subclass of cfx.Settings, not {schema!r}")
    if "name" in schema.model_fields:
        raise PluginError(f"{found}: its settings must not have a field 'name', which chooses the component itself")
    if found.kind == "model":
        _check_model(found, cls, base)


def _check_model(found: Entry, cls: Any, base: Any) -> None:
    from cfx.parameters import ParameterSpace

    space = getattr(cls, "parameters", None)
    if not isinstance(space, ParameterSpace):
        raise PluginError(f"{found}: its attribute 'parameters' must be a cfx.ParameterSpace, not {type(space).__name__}")
    if not space.tuned:
        raise PluginError(f"{found}: at least one of its parameters must be tuned")
    if not issubclass(cls.schema, base.schema):
        raise PluginError(f"{found}: its schema must extend {base.schema.__module__}.{base.schema.__name__}")


def _base(kind: Kind) -> Any:
    module, _, attribute = kind.base.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _unimplemented(cls: type) -> set[str]:
    """Returns names that are still marked abstract; `Component` needs no ABCMeta for its subclasses to be checked."""
    return {name for name in dir(cls) if getattr(inspect.getattr_static(cls, name), "__isabstractmethod__", False)}


def _without_blanks(schema: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Leaves out null for settings that are required and cannot be null, so that the error asks for a value."""
    kept = {}
    for key, value in values.items():
        field = schema.model_fields.get(key)
        if value is None and field is not None and is_blank(field):
            continue
        nested: Any = field.annotation if field is not None else None
        is_settings = inspect.isclass(nested) and issubclass(nested, BaseModel) and isinstance(value, Mapping)
        kept[key] = _without_blanks(nested, value) if is_settings else value
    return kept


def is_blank(field: FieldInfo) -> bool:
    """Says whether a config node holds null for this setting only because the user must give a value."""
    return field.is_required() and type(None) not in get_args(field.annotation)
