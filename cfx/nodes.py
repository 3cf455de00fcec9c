"""A component's config node, written from its class: the name, its settings' defaults, and a model's parameters in full.

One function renders it for everybody: third parties' nodes on the fly (`cfx.hydra_source`), the built-in components' into
`conf/<group>/<name>.yaml`, so that composing a config imports no torch. `make conf` (`python -m cfx.nodes`) writes these anew.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel
from pydantic_core import to_jsonable_python

from cfx import registry
from cfx.component import Component
from cfx.errors import CfxError
from cfx.parameters import Parameter, ParameterSpace

DISTRIBUTION = registry.OWN
"""The distribution whose components have their nodes as files."""

_WIDTH = 130
"""Longest line with a comment behind its value; a longer comment goes above."""


def conf_dir() -> Path:
    """Returns the folder of cfx's own config files: inside the package when installed, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    inside, beside = package / "conf", package.parent / "conf"
    return inside if inside.is_dir() else beside


def render(cls: type[Component], name: str) -> str:
    """Returns a component's node as commented YAML.

    A setting that the user must give is null; `cfx.registry.create` then asks for it.
    """
    space = getattr(cls, "parameters", None)
    lines = [*_comment(_summary(cls)), f"name: {_scalar(name)}"]
    lines += _settings(
        cls.schema, {}, skip={"parameters"} if isinstance(space, ParameterSpace) else set()
    )
    if isinstance(space, ParameterSpace):
        lines.append(
            "parameters:"
            if space.parameters
            else "parameters: null  # required: {NAME: {low: , high: , default: }}"
        )
        for parameter in space:
            lines += [f"  {line}" for line in _parameter(parameter)]
    return "\n".join(lines) + "\n"


def file_text(entry: registry.Entry) -> str:
    """Returns the text of a built-in component's file in `conf/`.

    Raises:
        PluginError: the component cannot be loaded.
    """
    cls = registry.get(entry.kind, entry.name)
    return f"# Written by `make conf` from {entry.target}; change the class, not this file.\n{render(cls, entry.name)}"


def file_path(entry: registry.Entry) -> Path:
    """Returns where a built-in component's file belongs."""
    return conf_dir() / registry.kind_of(entry.kind).group / f"{entry.name}.yaml"


def built_in() -> list[registry.Entry]:
    """Returns the entries of cfx itself that have a config node."""
    return [
        entry
        for kind, about in registry.KINDS.items()
        if about.chosen
        for entry in registry.entries(kind)
        if entry.distribution == DISTRIBUTION
    ]


def write_all() -> int:
    """Writes the file of every built-in component; returns how many could not be loaded."""
    failed = 0
    for entry in built_in():
        try:
            text = file_text(entry)
        except CfxError as error:
            failed += 1
            print(error, file=sys.stderr)  # the components that do load still get their files
            continue
        path = file_path(entry)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"wrote {path}")
    return failed


def _settings(
    schema: type[BaseModel], values: Mapping[str, Any], skip: set[str] | None = None
) -> Iterator[str]:
    for name, field in schema.model_fields.items():
        if name in (skip or set()):
            continue
        blank = field.is_required()
        value = values.get(
            name, None if blank else field.get_default(call_default_factory=True, validated_data={})
        )
        note = " ".join(
            part for part in ("required:" if blank else "", field.description or "") if part
        )
        if isinstance(value, BaseModel):
            yield from _comment(note)
            yield f"{_scalar(name)}:"
            yield from (
                f"  {line}"
                for line in _settings(
                    type(value), {key: getattr(value, key) for key in type(value).model_fields}
                )
            )
        else:
            yield from _line(name, _value(to_jsonable_python(value)), note)


def _parameter(parameter: Parameter) -> list[str]:
    source = f" ({parameter.source})" if parameter.source else ""
    node = {
        "low": parameter.low,
        "high": parameter.high,
        "default": parameter.default,
        "tuned": parameter.tuned,
    }
    return [
        *_comment(f"{parameter.name}, {parameter.unit}: {parameter.meaning}{source}"),
        f"{_scalar(parameter.name)}: {_value(node)}",
    ]


def _line(name: str, value: str, note: str) -> list[str]:
    line = f"{_scalar(name)}: {value}"
    if not note:
        return [line]
    short = f"{line}  # {note}"
    return [short] if len(short) <= _WIDTH and "\n" not in note else [*_comment(note), line]


def _comment(text: str) -> list[str]:
    return [f"# {part}" for line in text.splitlines() for part in textwrap.wrap(line, _WIDTH - 2)]


def _summary(cls: type[Component]) -> str:
    first = (inspect.getdoc(cls) or "").partition("\n\n")[0]
    reference = str(getattr(cls, "reference", "") or "")
    return "\n".join(part for part in (first, reference) if part)


def _value(value: Any) -> str:
    """Returns plain data as one line of YAML."""
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{_scalar(key)}: {_value(item)}" for key, item in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    if isinstance(value, str) and not (
        re.fullmatch(r"[A-Za-z_]\w*", value, re.ASCII) and yaml.safe_load(value) == value
    ):
        return json.dumps(value.replace("${", r"\${"))  # quoted, and never an interpolation
    return str(yaml.safe_dump([value], default_flow_style=True).strip()[1:-1])


if __name__ == "__main__":
    sys.exit(1 if write_all() else 0)
