"""The tables of `cfx plugins` and `cfx plugins show`."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from typing import Any, cast, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python
from rich.table import Table
from rich.text import Text

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.console import blank_table, put


def overview() -> None:
    """Prints a row for every component. Imports none."""
    rows = blank_table("kind", "name", "distribution", "version", "from", "state")
    troubled = False
    for kind in registry.KINDS:
        for entry in registry.entries(kind):
            now = state(entry)
            troubled = troubled or now in {"broken", "shadowed"}
            rows.add_row(kind, entry.name, entry.distribution, entry.version, entry.location, now)
    put(rows)
    if troubled:
        print("cfx plugins check says what is wrong, and what to do.")


def state(entry: registry.Entry) -> str:
    """Returns what is known of a component without importing it.

    It is shadowed, broken, fine (used already) or not loaded.
    """
    if registry.rivals(entry):
        return "shadowed"
    if registry.other_api(entry):
        return "broken"
    if registry.is_loaded(entry):
        return "fine"
    return "not loaded"


def show(kind: str, name: str) -> None:
    """Prints what a component is: where it comes from, what it does, its parameters and settings.

    Raises:
        PluginError: there is none of that name, or it cannot be loaded.
    """
    entry = registry.entry(kind, name)
    cls: Any = registry.get(kind, name)
    group = registry.kind_of(kind).group
    print(f"{entry}\n{entry.location}\n{_use(entry, cls)}\n")
    if cls.deprecated:
        print(f"Deprecated: {cls.deprecated}\n")
    print(f"{inspect.getdoc(cls) or '(its class has no docstring)'}\n")
    for line in _reference(cls):
        print(f"{line}\n")
    if entry.kind == "objective":
        print(f"Unit: {cls.unit or 'none'}\n")
    about = {"model": _parameters, "metric": _metric, "table": _columns}.get(entry.kind)
    if about is not None:
        put(about(cls))
    title = f"Settings (set with {group}.SETTING=VALUE)"
    settings = blank_table("setting", "default", "values", "meaning", title=title)
    settings.columns[0].no_wrap = True
    for row in _settings(cls.schema):
        if entry.kind != "model" or row[0] != "parameters":
            settings.add_row(*row)
    if settings.row_count:
        put(settings)
    else:
        print("It has no settings.")


def _use(entry: registry.Entry, cls: Any) -> str:
    """Returns how a component comes into a job."""
    name, group = entry.name, registry.kind_of(entry.kind).group
    if entry.kind == "command":
        return f"Run it with cfx {name}; cfx {name} --help says what it takes."
    if entry.kind == "table":
        return f"Every job that has rows of it writes {name}{cls.suffix}."
    if entry.kind == "metric":
        return f"Every job measures it; with {group}={name} no others but those that a job needs."
    return f"Choose it with {group}={name}."


def _reference(cls: type[Component]) -> Iterator[str]:
    """Yields where a component comes from: its reference, or the docstring of its module."""
    reference = getattr(cls, "reference", "")
    if reference:
        yield f"Reference: {reference}"
        return
    about = inspect.getdoc(inspect.getmodule(cls))
    if about:
        yield f"From its module: {about}"


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


def _parameters(cls: Any) -> Table:
    """Returns a model's parameters as a table; sources stand below it, so that lines stay short."""
    headings = ("parameter", "unit", "low", "high", "default", "tuned", "meaning", "source")
    rows = blank_table(*headings, title="Parameters")
    rows.columns[0].no_wrap = True
    sources = list(dict.fromkeys(p.source for p in cls.parameters if p.source))
    for p in cls.parameters:
        numbers = [f"{value:g}" for value in (p.low, p.high, p.default)]
        tuned = "constant"
        if p.tuned:
            tuned = "yes"
        if p.tuned and p.used_with is not None:
            tuned = f"with {p.used_with[0]}={p.used_with[1]}"
        mark = ""
        if p.source:
            mark = f"[{sources.index(p.source) + 1}]"
        rows.add_row(p.name, p.unit, *numbers, tuned, p.meaning, mark)
    below = []
    for number, source in enumerate(sources, start=1):
        below.append(f"[{number}] {source}")
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
    words = _type(kind)
    if _is_union(kind):
        words = " or ".join(_type(one) for one in get_args(kind))
    parts = [words]
    for rule in field.metadata:
        for key, sign in _SIGNS.items():
            if hasattr(rule, key):
                parts.append(f"{sign} {getattr(rule, key)}")
    return ", ".join(parts)


_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
"""Bounds as pydantic calls them, and as they are written."""


def _is_union(kind: Any) -> bool:
    return type(None) in get_args(kind)


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
