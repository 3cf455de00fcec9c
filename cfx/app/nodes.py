"""A component's config node, written from its class: name, settings and a model's parameters.

One function renders it for everybody: third parties' nodes on the fly (`cfx.app.hydra_source`), the
built-in components' into `conf/<group>/<name>.yaml`, so that composing a config imports no torch.
`make conf` (`python -m cfx.app.nodes`) writes these anew, and which distribution of this repository
brings the options that are not built in.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel
from pydantic_core import to_jsonable_python

import cfx
from cfx.core import registry
from cfx.core.component import Component
from cfx.core.distributions import FILE, OWN, options_of_checkout
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import CfxError

_WIDTH = 100
"""Longest line with a comment behind its value; a longer comment goes above."""


def shipped(name: str) -> Path:
    """Returns what lies inside the package when installed, and beside it in a checkout."""
    package = Path(cfx.__file__).resolve().parent
    inside = package / name
    return inside if inside.exists() else package.parent / name


def conf_dir() -> Path:
    """Returns the folder of cfx's own config files."""
    return shipped("conf")


def render(cls: type[Component], name: str) -> str:
    """Returns a component's node as commented YAML.

    A setting that the user must give is null; `cfx.core.registry.create` then asks for it.
    """
    space = getattr(cls, "parameters", None)
    first = (inspect.getdoc(cls) or "").partition("\n\n")[0]
    reference = str(getattr(cls, "reference", "") or "")
    lines = [*_comment(f"{first}\n{reference}"), f"name: {_scalar(name)}"]
    defaults: dict[str, Any] = {}
    for setting, field in cls.schema.model_fields.items():
        defaults[setting] = None
        if not field.is_required():
            defaults[setting] = field.get_default(call_default_factory=True, validated_data={})
    if not isinstance(space, ParameterSpace):
        return "\n".join([*lines, *_settings(cls.schema, defaults)]) + "\n"
    defaults.pop("parameters", None)
    lines += _settings(cls.schema, defaults)
    if space.parameters:
        lines.append("parameters:")
        for parameter in space:
            lines += _indented(_parameter(parameter))
    else:
        lines.append("parameters: null  # required: {NAME: {low: , high: , default: }}")
    return "\n".join(lines) + "\n"


def file_text(entry: registry.Entry) -> str:
    """Returns the text of a built-in component's file in `conf/`.

    Raises:
        PluginError: the component cannot be loaded.
    """
    cls = registry.get(entry.kind, entry.name)
    head = f"# Written by `make conf` from {entry.target}; change the class, not this file."
    return f"{head}\n{render(cls, entry.name)}"


def file_path(entry: registry.Entry) -> Path:
    """Returns where a built-in component's file belongs."""
    return conf_dir() / registry.kind_of(entry.kind).group / f"{entry.name}.yaml"


def built_in() -> list[registry.Entry]:
    """Returns the entries of cfx itself that have a config node."""
    nodes = []
    for kind, about in registry.KINDS.items():
        if not about.chosen:
            continue
        for entry in registry.entries(kind):
            if entry.distribution == OWN:
                nodes.append(entry)
    return nodes


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


def write_distributions() -> None:
    """Writes which distribution of this checkout brings which option (`cfx.core.distributions`)."""
    text = distributions_text(conf_dir().parent)
    if FILE.read_text(encoding="utf-8") != text:
        FILE.write_text(text, encoding="utf-8")
        print(f"wrote {FILE}")


def distributions_text(root: Path) -> str:
    """Returns the text of `distributions.json` for the checkout in `root`."""
    groups = {}
    for kind in (*registry.KINDS.values(), *registry.SIMPLE_KINDS.values()):
        if kind.name not in {"metric", "head"}:
            groups[kind.entry_points] = kind.group
    return json.dumps(options_of_checkout(root, groups), indent=1) + "\n"


def _settings(schema: type[BaseModel], values: Mapping[str, Any]) -> list[str]:
    """Returns the lines of some settings: values with their descriptions as comments."""
    lines: list[str] = []
    group = None
    for name, value in values.items():
        field = schema.model_fields[name]
        if _group(schema, name) != group:
            group = _group(schema, name)
            lines += _comment(f"-- {group}")
        note = field.description or ""
        if field.is_required():
            note = f"required: {note}".strip()
        if isinstance(value, BaseModel):
            lines += _comment(note)
            lines.append(f"{_scalar(name)}:")
            lines += _indented(_settings(type(value), dict(value)))
        else:
            lines += _line(name, _value(to_jsonable_python(value)), note)
    return lines


def _group(schema: type[BaseModel], name: str) -> str | None:
    """Returns the heading of a setting, where settings are put together from several classes."""
    if len(schema.__bases__) < 2:
        return None
    for base in schema.__mro__:
        if name in base.__annotations__:
            return (inspect.getdoc(base) or "").partition("\n")[0].rstrip(".")
    return None


def _parameter(parameter: Parameter) -> list[str]:
    about = f"{parameter.name}, {parameter.unit}: {parameter.meaning}"
    if parameter.source:
        about += f" ({parameter.source})"
    tuned: bool | None = parameter.tuned
    if parameter.used_with is not None and parameter.tuned:
        setting, value = parameter.used_with
        about += f"; tuned: null is true with {setting}={value}, else false"
        tuned = None
    node = {
        "low": parameter.low,
        "high": parameter.high,
        "default": parameter.default,
        "tuned": tuned,
    }
    return [*_comment(about), f"{_scalar(parameter.name)}: {_value(node)}"]


def _line(name: str, value: str, note: str) -> list[str]:
    """Returns a key with its value, and its comment behind it or, if it is long, above."""
    line = f"{_scalar(name)}: {value}"
    if not note:
        return [line]
    short = f"{line}  # {note}"
    if len(short) <= _WIDTH and "\n" not in note:
        return [short]
    return [*_comment(note), line]


def _comment(text: str) -> list[str]:
    lines = []
    for paragraph in text.splitlines():
        lines += textwrap.wrap(paragraph, _WIDTH, initial_indent="# ", subsequent_indent="# ")
    return lines


def _indented(lines: list[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _value(value: Any) -> str:
    """Returns plain data as one line of YAML."""
    if isinstance(value, Mapping):
        items = [f"{_scalar(key)}: {_value(item)}" for key, item in value.items()]
        return "{" + ", ".join(items) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    """Returns one value; a text is quoted unless it is a plain word, and is no interpolation."""
    if isinstance(value, str):
        is_word = re.fullmatch(r"[A-Za-z_]\w*", value, re.ASCII) and yaml.safe_load(value) == value
        if not is_word:
            return json.dumps(value.replace("${", r"\${"))
    return str(yaml.safe_dump([value], default_flow_style=True).strip()[1:-1])


if __name__ == "__main__":
    write_distributions()
    sys.exit(1 if write_all() else 0)
