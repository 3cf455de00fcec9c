"""One lazy registry for every kind of component, of cfx itself and of third parties.

All components come in by entry points. `names` and `entries` read the metadata of installed
distributions and import nothing. `get` imports the one component that is asked for, checks it, and
only then keeps it. `create` tries it for some milliseconds before a job relies on it. A broken
plugin therefore never harms a run that does not name it, and stops one that does with a sentence
that names its distribution.

A distribution says which version of the plugin API it was built for by an entry point of the group
`cfx.api` whose name is the version, so that this is known without importing it:

    [project.entry-points."cfx.api"]
    1 = "my_package"
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import itertools
import logging
import os
import sys
import traceback
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cfx.core.component import API_VERSION, Component, Settings, validate
from cfx.core.contract import violations
from cfx.core.distributions import ALL_OWN, OWN, advice
from cfx.core.guest import same_environment
from cfx.errors import CfxError, ConfigError, PluginError, Terminated, in_words, nearest

__all__ = [
    "KINDS",
    "create",
    "entries",
    "installed",
]
"""What plugins may use, as `cfx.plugin.registry`."""


log = logging.getLogger(__name__)

T = TypeVar("T")
R = TypeVar("R")

THIS_PROCESS = "this process"
"""Stands for the distribution of a component that a program has added."""

KINDS_GROUP = "cfx.kinds"
"""Entry-point group in which a distribution announces a kind of its own: name and base class."""

API_GROUP = "cfx.api"
"""Entry-point group in which a distribution says which version of the plugin API it needs."""


@dataclass(frozen=True)
class Kind:
    """A kind of component.

    Attributes:
        name: as in `cfx.get(kind, name)`.
        base: module and class that its components extend.
        group: its config group, the folder in `conf/` and the key in configs; by default its name.
        first: module and name of the statements that a new component is held to; base classes of
            the other kinds check what a component gives.
        chosen: a job chooses one of this kind, by a config group; metrics are all measured, tables
            are all written, a policy has several inputs, and sub-commands are none of a job.
    """

    name: str
    base: str
    group: str = ""
    first: str = ""
    chosen: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "group", self.group or self.name)

    @property
    def entry_points(self) -> str:
        """Its entry-point group, the plural of its name: `cfx.models`."""
        if self.name.endswith("y"):
            return f"cfx.{self.name[:-1]}ies"
        return f"cfx.{self.name}s"

    def call(self, component: str) -> str:
        """Returns what a user writes to ask for a component."""
        if self.name == "command":
            return f"cfx {component}"
        if self.name == "export":
            return f"cfx export JOB --to {component}"
        if self.name == "input":
            return f"policy.inputs=[{component}]"
        return f"{self.group}={component}"


def _by_name(*kinds: Kind) -> dict[str, Kind]:
    return {kind.name: kind for kind in kinds}


KINDS = _by_name(
    Kind("dataset", "cfx.data.base:Dataset", group="data"),
    Kind("model", "cfx.models.base:DrivingModel", first="cfx.models.contract:FIRST"),
    Kind("policy", "cfx.policies.base:Policy", first="cfx.policies.contract:FIRST"),
    Kind(
        "optimizer",
        "cfx.calibration.optimizers:Optimizer",
        first="cfx.calibration.contract:FIRST_OF_OPTIMIZERS",
    ),
    Kind(
        "simulator",
        "cfx.simulation.base:Simulator",
        first="cfx.simulation.contract:FIRST",
    ),
    Kind(
        "objective",
        "cfx.calibration.objectives:Objective",
        first="cfx.calibration.contract:FIRST_OF_OBJECTIVES",
    ),
    Kind("input", "cfx.policies.inputs.base:PolicyInput", group="policy.inputs", chosen=False),
    Kind("engine", "cfx.core.engine:Engine"),
    Kind("learner", "cfx.learners.base:Learner"),
    Kind("protocol", "cfx.evaluation.protocols.base:Protocol"),
    Kind(
        "metric",
        "cfx.evaluation.metrics.base:Metric",
        group="metrics",
        first="cfx.evaluation.metrics.contract:FIRST",
        chosen=False,
    ),
    Kind("table", "cfx.results.table:ResultTable", chosen=False),
    Kind("demo", "cfx.evaluation.demo:Demo"),
    Kind("command", "cfx.core.command:Command", chosen=False),
)
"""All kinds, by name."""

SIMPLE_KINDS = _by_name(
    Kind("figure", "cfx.results.figure:JobFigure", chosen=False),
    Kind("head", "cfx.policies.heads.base:ParameterHead", group="learner.head", chosen=False),
    Kind("export", "cfx.core.command:ExportFormat", chosen=False),
    Kind(
        "posterior",
        "cfx.calibration.posterior:PosteriorMethod",
        group="calibration.posterior",
        chosen=False,
    ),
    Kind("tracker", "cfx.results.tracker:Tracking", group="tracking.name", chosen=False),
)
"""Kinds of classes that come in the same way, have no settings, and no contract in cfx-contracts.

Other distributions have more of them, by an entry point of the group `cfx.kinds` each.
"""

GROUPS: dict[str, Kind] = {kind.group: kind for kind in KINDS.values() if kind.chosen}
"""Kinds by config group, of which a job chooses one component each; of demo perhaps none."""


@dataclass(frozen=True)
class Entry:
    """One component as its distribution's metadata announces it.

    Attributes:
        kind, name: how it is asked for.
        target: `module:Class`.
        distribution, version: who brings it.
        location: folder that the distribution's metadata lies in.
        summary: one line about the distribution, of its author.
        api: versions of the plugin API that the distribution declares; empty if it declares none.
    """

    kind: str
    name: str
    target: str
    distribution: str
    version: str
    location: str
    summary: str = ""
    api: tuple[str, ...] = ()

    @property
    def package(self) -> str:
        """Top-level package of the class."""
        return self.target.partition(":")[0].partition(".")[0]

    def __str__(self) -> str:
        return (
            f"{self.kind} '{self.name}' ({self.target})"
            f" of the distribution {self.distribution} {self.version}"
        )


_loaded: dict[Entry, type[Component]] = {}
"""Classes that were imported and passed their checks."""

_additions = itertools.count(1)
"""Numbers of what `add` adds: a class that is defined anew is another one."""

_of_this_process: dict[tuple[str, str], Entry] = {}
"""Entries that `add` made, by kind and name."""

_tried: set[tuple[Entry, str]] = set()
"""Components that were tried, with their settings as JSON."""


def every_kind() -> dict[str, Kind]:
    """Returns all kinds by name: components first, then what comes in the same way.

    Those of other distributions come last. Imports nothing.
    """
    return {**KINDS, **SIMPLE_KINDS, **_kinds_of_plugins(_search_path())}


@functools.lru_cache(maxsize=1)
def _kinds_of_plugins(search_path: tuple[tuple[str, float], ...]) -> dict[str, Kind]:
    """Returns the kinds that other distributions announce: an entry point is a base class each."""
    kinds = {}
    for announced in _announced(search_path).get(KINDS_GROUP, ()):
        if announced.name not in KINDS and announced.name not in SIMPLE_KINDS:
            kinds[announced.name] = Kind(announced.name, announced.target, chosen=False)
    return kinds


def kind_of(kind: str) -> Kind:
    """Returns a kind by its name or by its config group (`dataset` or `data`).

    Raises:
        PluginError: there is no such kind.
    """
    kinds = every_kind()
    for candidate in kinds.values():
        if kind in {candidate.name, candidate.group}:
            return candidate
    raise PluginError(
        f"there is no kind of component '{kind}'.{nearest(kind, kinds)} Known: {', '.join(kinds)}."
    )


def entries(kind: str) -> tuple[Entry, ...]:
    """Returns what the installed distributions announce, sorted by name. Imports nothing.

    Two entries may share a name.

    Raises:
        PluginError: there is no such kind.
    """
    announced = _of_kind(kind_of(kind))
    every = list(announced)
    for added in _of_this_process.values():
        if added.kind == kind_of(kind).name:
            every.append(added)
    return _sorted(every)


def names(kind: str) -> tuple[str, ...]:
    """Returns the names of all components of a kind, sorted. Imports nothing."""
    return tuple(sorted({entry.name for entry in entries(kind)}))


def entry(kind: str, name: str) -> Entry:
    """Returns the one entry of that name. Imports nothing.

    Raises:
        PluginError: the name is unknown, or two third parties claim it. A name of cfx's own always
            means cfx's own.
    """
    about = kind_of(kind)
    call, what = about.call(name), about.name
    claims = _that_count(_of_name(kind, name))
    if not claims:
        options = names(kind)
        if not options and about.name in KINDS:
            raise PluginError(
                f"{call}: no {what} is installed, not even cfx's own;"
                " run make run, or pip install -e ."
            )
        raise PluginError(
            f"{call}: there is no {what} '{name}'.{advice(about.group, name, options)}"
        )
    if len(claims) > 1:
        texts = []
        for claim in claims:
            texts.append(f"{claim.distribution} {claim.version} ({claim.target})")
        raise PluginError(
            f"{call}: two distributions bring a {what} '{name}': {' and '.join(texts)};"
            " uninstall one of them"
        )
    return claims[0]


def _of_name(kind: str, name: str) -> list[Entry]:
    """Returns the entries of a name, of whatever distribution."""
    return [announced for announced in entries(kind) if announced.name == name]


def _that_count(claims: list[Entry]) -> list[Entry]:
    """Returns cfx's own of some entries of one name, which no other replaces; without it, all."""
    for claim in claims:
        if claim.distribution == OWN:
            return [claim]
    return claims


def get(kind: str, name: str) -> type[Component]:
    """Imports, checks and returns a component's class.

    Raises:
        PluginError: the name is unknown or claimed twice; or the component was built for another
            version of the plugin API, cannot be imported, or breaks the contract of its kind.
    """
    announced = entry(kind, name)
    if announced not in _loaded:
        complaint = other_api(announced)
        if complaint:
            raise PluginError(complaint)
        cls = _import(announced)
        _check(announced, cls)
        _loaded[announced] = cls
    return _loaded[announced]


def add(kind: str, name: str, cls: type[Component]) -> None:
    """Makes a component known to this process, without a distribution, until it ends.

    One that was added under the same name before is replaced.

    Raises:
        PluginError: an installed distribution brings a component of that name, or what is given is
            no class or breaks the contract of its kind.
    """
    about = kind_of(kind)
    for other in _of_kind(about):
        if other.name == name:
            raise PluginError(
                f"{other} is installed, and {about.call(name)} means it; choose another name"
            )
    if not isinstance(cls, type):
        raise PluginError(f"{about.call(name)}: a {about.name} is a class, not {cls!r}")
    target = f"{cls.__module__}:{cls.__qualname__}"
    announced = Entry(about.name, name, target, THIS_PROCESS, str(next(_additions)), "")
    _check(announced, cls)
    cls.process_code = uuid.uuid4().hex
    before = _of_this_process.pop((about.name, name), None)
    if before is not None:
        _loaded.pop(before, None)
    _of_this_process[about.name, name] = announced
    _loaded[announced] = cls


def create(kind: str, node: Mapping[str, Any]) -> Component:
    """Creates a component from its config node: `name` and its settings.

    Raises:
        PluginError: as `get`; or it cannot be created, or breaks its contract when it is tried for
            a moment.
        ConfigError: the node has no name, an unknown key or a wrong value.
        ParameterError: a model's parameters contradict each other.
    """
    group = kind_of(kind).group
    if not isinstance(node, Mapping):
        raise ConfigError(
            f"{group}={node!r}: choose a {kind} by its name; known: {', '.join(names(kind))}"
        )
    name = node.get("name")
    if not isinstance(name, str):
        raise ConfigError(
            f"{group}.name: a value is required; choose a {kind}: {', '.join(names(kind))}"
        )
    cls, announced = get(kind, name), entry(kind, name)
    values = dict(node)
    del values["name"]
    settings = validate(cls.schema, _without_blanks(cls.schema, values), where=group)
    _warn_of_deprecated(announced, cls, settings)
    try:
        component = cls(settings)
    except CfxError:
        raise
    except Exception as error:
        raise PluginError(
            f"{announced} cannot be created: {in_words(error)}{_remedy(announced)}"
        ) from error
    _try(announced, component, settings)
    return component


@dataclass(frozen=True)
class Installed(Generic[T]):
    """One of a kind of which all that are installed take part, and who brings it.

    Attributes:
        kind: such as "figure".
        name: of its entry point.
        component: what it is.
        distribution: who brings it.
    """

    kind: str
    name: str
    component: T
    distribution: str

    def attempt(self, work: Callable[[T], R], without: R) -> R:
        """Returns what `work` makes of it.

        One of another distribution that fails is left out with a warning, and `without` is
        returned: the job has its results.
        """
        try:
            return work(self.component)
        except Exception as error:
            if self.distribution == OWN:
                raise
            _warn_of_left_out(self, f"{in_words(error)}; repair or uninstall it")
            return without


def installed(kind: str) -> tuple[Installed[Any], ...]:
    """Makes all of a kind with their default settings; returns them by their `order` and name.

    One of another distribution never replaces cfx's own. One that cannot be made is left out with a
    warning.

    Raises:
        PluginError: one of cfx's own cannot be made.
    """
    return _installed(kind, _search_path())


def chosen(
    kind: str, named: str | Iterable[str], distributions: Collection[str]
) -> tuple[Installed[Any], ...]:
    """Returns those of a kind that a job names, such as its tables and figures, in their order.

    Args:
        kind: whose components need no settings.
        named: `own`: cfx's own, and those of the job's distributions; `all`: all that are
            installed; `none`; or names, in which `own` may stand.
        distributions: that bring the job's components.

    Raises:
        PluginError: there is none of a name.
    """
    if named == "all":
        return installed(kind)
    names = {named} if isinstance(named, str) else set(named)
    for name in names - {ALL_OWN, "none"}:
        get(kind, name)
    components = []
    for component in installed(kind):
        is_own = component.distribution == OWN or component.distribution in distributions
        if component.name in names or (ALL_OWN in names and is_own):
            components.append(component)
    return tuple(components)


@functools.lru_cache(maxsize=8)
def _installed(
    kind: str,
    search_path: tuple[tuple[str, float], ...],  # noqa: ARG001 - part of the cache's key
) -> tuple[Installed[Any], ...]:
    components = []
    for announced in entries(kind):
        others = namesakes(announced)
        if others:
            _warn_of_left_out(announced, f"{others[0].distribution} brings one of that name")
            continue
        try:
            component: Any = create(kind, {"name": announced.name})
        except PluginError as error:
            if announced.distribution == OWN:
                raise
            _warn_of_left_out(announced, str(error))
            continue
        components.append(Installed(kind, announced.name, component, announced.distribution))
    return tuple(sorted(components, key=lambda one: (one.component.order, one.name)))


def _warn_of_left_out(component: Entry | Installed[Any], reason: str) -> None:
    log.warning(
        "%s %s of the distribution %s is left out: %s",
        component.kind,
        component.name,
        component.distribution,
        reason,
    )


def is_loaded(announced: Entry) -> bool:
    """Says whether the component was imported and passed its checks."""
    return announced in _loaded


def namesakes(announced: Entry) -> tuple[Entry, ...]:
    """Returns the entries of other distributions that keep this one from being used.

    It is empty for most. Imports nothing.
    """
    if announced.distribution == OWN:
        return ()
    others = [other for other in _of_name(announced.kind, announced.name) if other != announced]
    return tuple(_that_count(others))


def other_api(announced: Entry) -> str:
    """Returns a sentence if the distribution was built for other versions of the plugin API only.

    Returns "" if it was not. Imports nothing.
    """
    if announced.distribution == OWN or not announced.api or str(API_VERSION) in announced.api:
        return ""
    versions = [int(declared) for declared in announced.api if declared.isdecimal()]
    if not versions:
        return (
            f"{announced} declares '{announced.api[0]}' as its version of cfx's plugin API, which"
            f" is no number; its author must name the entry point of the group {API_GROUP} by one,"
            f" such as {API_VERSION}"
        )
    outdated = announced.distribution
    if min(versions) > API_VERSION:
        outdated = OWN
    return (
        f"{announced} was built for version {' and '.join(announced.api)} of cfx's plugin API, this"
        f" cfx has version {API_VERSION}; pip install --upgrade {outdated}, or pip uninstall"
        f" {announced.distribution}"
    )


def _entry_of(cls: type) -> Entry | None:
    """Returns what announced a class; None if no distribution did."""
    for announced, loaded in _loaded.items():
        if loaded is cls:
            return announced
    return None


def origin(component: Component | type[Component]) -> str:
    """Returns whose a component is, for messages: kind, name, class and distribution.

    A class that no distribution announces is named alone.
    """
    cls = component if isinstance(component, type) else type(component)
    return str(_entry_of(cls) or f"{cls.kind} {cls.__name__}")


def is_own(component: Component) -> bool:
    """Says whether a component is one of cfx's own."""
    announced = _entry_of(type(component))
    return announced is not None and announced.distribution == OWN


def name_of(component: Component) -> str:
    """Returns the name under which configs choose a component; its class's if it is none's."""
    announced = _entry_of(type(component))
    return type(component).__name__ if announced is None else announced.name


def _try(announced: Entry, component: Component, settings: BaseModel) -> None:
    """Holds a component to the first statements of its contract, once for each of its settings.

    Statements are assertions: python -O leaves this out.

    Raises:
        PluginError: it breaks its contract; names the distribution.
    """
    first = kind_of(announced.kind).first
    if not first or not __debug__:
        return
    key = (announced, settings.model_dump_json())
    if key in _tried:
        return
    for _, sentence in violations(component, _resolve(first)):
        raise PluginError(f"{announced} breaks its contract: {sentence}{_remedy(announced)}")
    _tried.add(key)


def _remedy(announced: Entry) -> str:
    if announced.distribution == THIS_PROCESS:
        return "; repair it"
    return (
        f"; repair that distribution (cfx plugins check {announced.kind} {announced.name}),"
        f" or pip uninstall {announced.distribution}"
    )


def _warn_of_deprecated(announced: Entry, cls: type[Component], settings: BaseModel) -> None:
    """Logs a warning for a deprecated component, and for each deprecated setting that is set."""
    if cls.deprecated:
        log.warning("%s is deprecated: %s", announced, cls.deprecated)
    for name, field in cls.schema.model_fields.items():
        if not field.deprecated:
            continue
        default = field.get_default(call_default_factory=True, validated_data={})
        if settings.__dict__[name] != default:  # getattr would raise pydantic's own warning
            path = f"{kind_of(announced.kind).group}.{name}"
            log.warning("%s of %s is deprecated: %s", path, announced, field.deprecation_message)


def _search_path() -> tuple[tuple[str, float], ...]:
    """Returns a stamp that changes when a distribution is installed.

    With it as a key of a cache, a new plugin is seen without a restart.
    """
    stamps = []
    for folder in sys.path:
        if folder:
            try:
                stamps.append((folder, os.stat(folder).st_mtime))  # noqa: PTH116 - asked hundreds of times a job, and Path takes five times as long
            except OSError:
                continue
    return tuple(stamps)


def _sorted(announced: Iterable[Entry]) -> tuple[Entry, ...]:
    return tuple(sorted(announced, key=attrgetter("name", "distribution")))


def _of_kind(kind: Kind) -> tuple[Entry, ...]:
    return _announced(_search_path()).get(kind.entry_points, ())


@functools.lru_cache(maxsize=1)
def _announced(
    search_path: tuple[tuple[str, float], ...],  # noqa: ARG001 - the cache's key
) -> dict[str, tuple[Entry, ...]]:
    """Returns the entries of every entry-point group of cfx, sorted."""
    entries_by_kind: dict[str, list[Entry]] = {}
    distributions = set()
    for distribution in importlib.metadata.distributions():
        try:
            announced = list(_entries(distribution))
        except Exception:  # noqa: S112 - metadata that cannot be read announces nothing
            continue
        # The first of a name on the search path is the one that is imported.
        if announced and announced[0][1].distribution not in distributions:
            distributions.add(announced[0][1].distribution)
            for group, entry in announced:
                entries_by_kind.setdefault(group, []).append(entry)
    by_group = {}
    for group, announced_there in entries_by_kind.items():
        by_group[group] = _sorted(announced_there)
    return by_group


def _entries(distribution: importlib.metadata.Distribution) -> Iterator[tuple[str, Entry]]:
    """Yields what one distribution announces, each with its entry-point group."""
    api, ours = [], []
    for point in distribution.entry_points:
        if point.group == API_GROUP:
            api.append(point.name)
        elif point.group.startswith("cfx."):
            ours.append(point)
    if not ours:
        return
    kinds = {}
    for about in (*KINDS.values(), *SIMPLE_KINDS.values()):
        kinds[about.entry_points] = about.name
    metadata = distribution.metadata  # read anew each time that it is asked for
    name, version = metadata["Name"], metadata["Version"]
    if not isinstance(name, str) or not isinstance(version, str):
        raise ValueError("the metadata name no distribution, or no version")
    summary = metadata["Summary"] if "Summary" in metadata else ""  # noqa: SIM401 - typed so
    location = str(distribution.locate_file(""))
    for point in ours:
        kind = kinds.get(point.group, point.group.removeprefix("cfx.").removesuffix("s"))
        yield (
            point.group,
            Entry(
                kind, point.name, point.value, name, version, location, summary, tuple(sorted(api))
            ),
        )


def _import(announced: Entry) -> Any:
    module, _, attribute = announced.target.partition(":")
    try:
        with same_environment():  # libraries set variables as they are imported
            imported = importlib.import_module(module)
        return functools.reduce(getattr, attribute.split("."), imported)
    except (KeyboardInterrupt, Terminated):
        raise
    except BaseException as error:  # a plugin may raise anything, even SystemExit
        raise PluginError(
            f"{announced} cannot be imported: {in_words(error)};"
            f" repair that distribution, or pip uninstall {announced.distribution}"
        ) from error


def _check(announced: Entry, cls: Any) -> None:
    """Raises PluginError unless `cls` keeps the contract of its kind."""
    base = _resolve(kind_of(announced.kind).base)
    if not inspect.isclass(cls):
        raise PluginError(
            f"{announced} is no class but {type(cls).__name__};"
            f" point its entry point at a subclass of {base.__name__}"
        )
    if not issubclass(cls, base):
        raise PluginError(f"{announced} does not extend {base.__module__}.{base.__name__}")
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if missing:
        raise PluginError(f"{announced} does not implement {', '.join(missing)}")
    if not issubclass(cls, Component):
        return
    if cls.kind != base.kind:
        raise PluginError(
            f"{announced} says kind='{cls.kind}',"
            f" but a {announced.kind} keeps kind='{base.kind}' of its base class"
        )
    schema = cls.schema
    if not (inspect.isclass(schema) and issubclass(schema, Settings)):
        raise PluginError(
            f"{announced}: its schema must be a subclass of cfx.plugin.Settings, not {schema!r}"
        )
    if "name" in schema.model_fields:
        raise PluginError(
            f"{announced}: its settings must not have a field 'name',"
            " which chooses the component itself"
        )
    if announced.kind in {"model", "simulator"} and not issubclass(schema, base.schema):
        raise PluginError(
            f"{announced}: its schema must extend {base.schema.__module__}.{base.schema.__name__}"
        )
    complaint = cls.complaint()
    if complaint:
        raise PluginError(f"{announced}{complaint}")


def _resolve(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _without_blanks(schema: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Leaves out null where a value is required, so that the error asks for one."""
    filled: dict[str, Any] = {}
    for key, value in values.items():
        field = schema.model_fields.get(key)
        nested: Any = None if field is None else field.annotation
        if isinstance(value, Mapping) and inspect.isclass(nested) and issubclass(nested, BaseModel):
            filled[key] = _without_blanks(nested, value)
        elif value is not None or field is None or not is_blank(field):
            filled[key] = value
    return filled


def is_blank(field: FieldInfo) -> bool:
    """Says whether null in a config node means that the user must give a value."""
    return field.is_required() and type(None) not in get_args(field.annotation)


# --- errors of plugins' code ----------------------------------------------------------------------

_PACKAGE = Path(__file__).resolve().parent.parent


def blame(
    error: BaseException, more: str = "the whole traceback is in the log"
) -> PluginError | None:
    """Returns a sentence if an error comes from a plugin's code; None if it is cfx's own.

    The innermost frame that is cfx's or a plugin's decides: what a library answers to a plugin's
    call is the plugin's.

    Args:
        more: where the traceback is.
    """
    failure = in_words(error)
    if isinstance(error, SystemExit):
        failure = f"it called sys.exit({error.code!r})"
    elif isinstance(error, MemoryError):
        failure = "memory ran out"
    packages = _packages()
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename).resolve()
        if file.is_relative_to(_PACKAGE):
            return None
        for package, announced in packages.items():
            if file.is_relative_to(package):
                where = f"{file.relative_to(package.parent)}, line {frame.lineno}"
                return PluginError(
                    f"{announced} failed in {where}: {failure}; {more};"
                    f" repair that distribution, or pip uninstall {announced.distribution}"
                )
    return None


def _packages() -> dict[Path, Entry]:
    """Returns the places of plugins' code: a package's folder, or a single module's file."""
    by_place: dict[Path, Entry] = {}
    for kind in every_kind():
        for announced in entries(kind):
            if announced.distribution not in {OWN, THIS_PROCESS}:
                for place in _places(announced.package):
                    by_place.setdefault(place, announced)
    return by_place


def _places(module: str) -> list[Path]:
    """Returns where a module's code is; nothing if it cannot be found."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return []
    first = next(iter(spec.submodule_search_locations or ()), spec.origin)
    return [] if first is None else [Path(first).resolve()]
