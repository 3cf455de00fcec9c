"""`cfx plugins`: what is installed."""

from __future__ import annotations

import argparse
import inspect
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, cast, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from cfx.app.completion import add_kind, complete_with
from cfx.core import registry
from cfx.core.command import Command
from cfx.core.component import Component
from cfx.core.console import blank_table, print_table
from cfx.core.distributions import OWN

if TYPE_CHECKING:
    from rich.table import Table


class PluginsCommand(Command):
    """Shows, checks and writes components."""

    summary = "installed components; show prints one (check and new: cfx-contracts)"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx plugins",
            description="Shows the installed components, without importing any. cfx plugins check"
            " tries them and cfx plugins new writes a package of your own (cfx-contracts).",
        )
        actions = parser.add_subparsers(dest="action")
        show = actions.add_parser("show", help="a component's parameters, settings and reference")
        add_kind(show)
        complete_with(
            show.add_argument("name", help="one component"),
            lambda options: registry.names(options.kind),
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        if options.action == "show":
            show(options.kind, options.name)
        else:
            overview()
        return 0


def overview() -> None:
    """Prints a row for everything that is installed. Imports none of it."""
    rows = blank_table("kind", "name", "distribution", "version", "from", "state")
    states = set()
    for kind in registry.every_kind():
        for entry in registry.entries(kind):
            state = _state(entry)
            states.add(state)
            rows.add_row(kind, entry.name, entry.distribution, entry.version, entry.location, state)
    print_table(rows)
    if states & {"broken", "shadowed"}:
        print("cfx plugins check says what is wrong, and what to do.")


def _state(entry: registry.Entry) -> str:
    """Returns a component's state, as far as it is known without importing the component."""
    if registry.namesakes(entry):
        return "shadowed"
    if registry.other_api(entry):
        return "broken"
    return "fine" if registry.is_loaded(entry) else "not loaded"


def show(kind: str, name: str) -> None:
    """Prints what a component is: where it comes from, what it does, its parameters and settings.

    Heads, formats of `cfx export`, posteriors and places that keep runs have no settings.

    Raises:
        PluginError: there is none of that name, or it cannot be loaded.
    """
    entry = registry.entry(kind, name)
    cls: Any = registry.get(kind, name)
    group = registry.kind_of(kind).group
    print(f"{entry}\n{entry.location}\n{_use(entry, cls)}\n")
    is_component = issubclass(cls, Component)
    if is_component and cls.deprecated:
        print(f"Deprecated: {cls.deprecated}\n")
    print(f"{inspect.getdoc(cls) or '(its class has no docstring)'}\n")
    reference = getattr(cls, "reference", "")
    of_module = inspect.getdoc(inspect.getmodule(cls))
    if reference:
        print(f"Reference: {reference}\n")
    elif of_module:
        print(f"From its module: {of_module}\n")
    if entry.kind == "objective":
        print(f"Unit: {cls.unit or 'none'}\n")
    tables = {"model": _parameters, "metric": _metric, "table": _columns, "input": _signals}
    about = tables.get(entry.kind)
    if about is not None:
        print_table(about(cls))
    title = f"Settings (set with {group}.SETTING=VALUE)"
    settings = blank_table("setting", "default", "values", "meaning", title=title)
    settings.columns[0].no_wrap = True
    if is_component:
        for row in _settings(cls.schema):
            if entry.kind != "model" or row[0] != "parameters":
                settings.add_row(*row)
    if settings.row_count:
        print_table(settings)
    else:
        print("It has no settings.")


def _use(entry: registry.Entry, cls: Any) -> str:
    """Returns how a component comes into a job."""
    name, kind = entry.name, registry.kind_of(entry.kind)
    if entry.kind == "command":
        return f"Run it with cfx {name}; cfx {name} --help says what it takes."
    if entry.kind == "table":
        return f"{_jobs_with('tables', entry)} writes {name}{cls.suffix} where it has rows of it."
    if entry.kind == "figure":
        jobs = _jobs_with("figures", entry)
        return f"{jobs} draws it where it has what it shows: figures/{name}.png."
    if entry.kind == "metric":
        jobs = _jobs_with("metrics", entry)
        return f"{jobs} measures it; with {kind.call(name)} no others but those that a job needs."
    if entry.kind == "input":
        return f"Choose it with policy.inputs=[situation,{name}], beside the usual ones."
    return f"Choose it with {kind.call(name)}."


def _jobs_with(setting: str, entry: registry.Entry) -> str:
    """Returns which jobs have a table, figure or metric: cfx's own need not be named."""
    if entry.distribution == OWN:
        return "Every job"
    return f"A job with {setting}=[own,{entry.name}]"


def _metric(cls: Any) -> Table:
    """Returns what tables say of a metric."""
    rows = blank_table("heading", "unit", "better", "over pairs", "scopes", "meaning")
    scopes = ", ".join(cls.scopes)
    rows.add_row(cls.heading, cls.unit, cls.direction, cls.summary, scopes, cls.meaning)
    return rows


def _columns(cls: Any) -> Table:
    """Returns the columns of a table of results."""
    rows = blank_table("column", "unit", "type", "meaning", title="Columns")
    rows.columns[0].no_wrap = True
    for column in cls.columns:
        rows.add_row(column.name, column.unit, column.dtype, column.meaning)
    return rows


def _signals(cls: Any) -> Table:
    """Returns the signals that an input of policies reads, and what it makes of them."""
    rows = blank_table("signal", "unit", "column", "meaning", title=f"{cls.meaning} [{cls.unit}]")
    rows.columns[0].no_wrap = True
    for signal in cls.signals:
        rows.add_row(signal.name, signal.unit, signal.column, signal.meaning)
    return rows


def _parameters(cls: Any) -> Table:
    """Returns a model's parameters as a table; sources stand below it, so that lines stay short."""
    from rich.text import Text

    headings = ("parameter", "unit", "low", "high", "default", "tuned", "meaning", "source")
    rows = blank_table(*headings, title="Parameters")
    rows.columns[0].no_wrap = True
    numbers: dict[str, int] = {}  # of the sources, in the order in which they are named
    below = []
    for p in cls.parameters:
        tuned = "yes" if p.tuned else "constant"
        if p.tuned and p.used_with is not None:
            tuned = f"with {p.used_with[0]}={p.used_with[1]}"
        mark = ""
        if p.source:
            if p.source not in numbers:
                numbers[p.source] = len(numbers) + 1
                below.append(f"[{numbers[p.source]}] {p.source}")
            mark = f"[{numbers[p.source]}]"
        low, high, default = f"{p.low:g}", f"{p.high:g}", f"{p.default:g}"
        rows.add_row(p.name, p.unit, low, high, default, tuned, p.meaning, mark)
    below.append("Change one with model.parameters.NAME.{low,high,default,tuned}=VALUE")
    rows.caption = Text("\n".join(below))
    rows.caption_justify = "left"
    return rows


def _settings(schema: type[BaseModel], path: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Yields path, default, possible values and meaning of each setting."""
    for name, field in schema.model_fields.items():
        shown = "required"
        if not field.is_required():
            default = field.get_default(call_default_factory=True, validated_data={})
            if isinstance(default, BaseModel):
                yield from _settings(type(default), f"{path}{name}.")
                continue
            shown = json.dumps(to_jsonable_python(default))
        meaning = field.description or ""
        if field.deprecated:
            meaning = f"{meaning} (deprecated: {field.deprecation_message})".strip()
        yield f"{path}{name}", shown, _values(field), meaning


def _values(field: FieldInfo) -> str:
    """Returns the type and the bounds that a setting must keep."""
    kind: Any = field.annotation
    parts = [_type(kind)]
    alternatives = get_args(kind)
    if type(None) in alternatives:  # a setting that may be null
        parts = [" or ".join(map(_type, alternatives))]
    for rule in field.metadata:
        for key, sign in {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}.items():
            if hasattr(rule, key):
                parts.append(f"{sign} {getattr(rule, key)}")
    return ", ".join(parts)


def _type(kind: Any) -> str:
    if kind is type(None):
        return "null"
    choices = get_args(kind)
    if get_origin(kind) is dict:
        return "mapping"
    if choices and all(isinstance(choice, str) for choice in choices):
        return "|".join(cast("tuple[str, ...]", choices))
    if choices:
        return str(kind).replace("typing.", "")
    return str(getattr(kind, "__name__", kind))
