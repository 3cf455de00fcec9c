"""The leaves of a job's configuration, and other values to set them to."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from cfx.core import registry
from cfx.errors import ConfigError
from cfx.results.config import JobConfig


def leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted keys of a configuration's leaves, and their values; names are none."""
    if isinstance(node, Mapping) and node:
        for name, value in node.items():
            if not (name == "name" and key in registry.GROUPS):
                yield from leaves(value, f"{key}.{name}".removeprefix("."))
    else:
        yield key, node


def other_values(key: str, value: Any, config: Mapping[str, Any]) -> list[Any]:
    """Returns values unlike the present one that its type allows, the nearest first.

    Args:
        key: of the leaf.
        value: it has.
        config: the job's, which names the components.
    """
    kinds = list(_kinds(_annotation(key, config)))
    found: list[Any] = []
    for kind in kinds:
        if get_origin(kind) is Literal:
            found += [one for one in get_args(kind) if one != value]
    if isinstance(value, bool) or (value is None and bool in kinds):
        found.append(not value)
    elif isinstance(value, int | float):
        found += _numbers(value, whole=float not in kinds)
    elif isinstance(value, list | tuple) and value:
        found += _lists(value)
    elif value is None:
        found += [3] if int in kinds else []
        found += [0.5, 2.0, 30.0] if float in kinds else []
    if type(None) in kinds and value is not None:
        found.append(None)
    return found


def written(value: Any) -> str:
    """Returns a value as Hydra's command line takes it."""
    return json.dumps(value).replace('"', "'") if not isinstance(value, str) else f"'{value}'"


def _numbers(value: float, *, whole: bool) -> list[Any]:
    if whole:
        return [value + 1, value * 2, *([value - 1] if value > 1 else [])]
    if value == 0:
        return [0.1, 0.5, 1.0]
    return [value * 0.9, value * 1.1, value * 0.5, value * 2]


def _lists(value: list[Any] | tuple[Any, ...]) -> list[Any]:
    if all(isinstance(one, int | float) for one in value):
        return [[one * 0.9 for one in value], [one * 1.1 for one in value], list(value)[:-1]]
    return [list(value)[:-1]] if len(value) > 1 else []


def _annotation(key: str, config: Mapping[str, Any]) -> Any:
    """Returns the declared type of a leaf; Any for one of a component's own mapping."""
    group, _, rest = key.partition(".")
    schema: Any = JobConfig
    names = key.split(".")
    if rest and group in registry.GROUPS:
        schema = registry.get(group, str(config[group]["name"])).schema
        names = rest.split(".")
    kind: Any = schema
    for name in names:
        models = [one for one in _kinds(kind) if isinstance(one, type)]
        fields = [one.model_fields for one in models if issubclass(one, BaseModel)]
        holders = [one for one in fields if name in one]
        if not holders:
            mappings = [one for one in _kinds(kind) if get_origin(one) is dict]
            kind = get_args(mappings[0])[1] if mappings else Any
            continue
        kind = holders[0][name].annotation
    return kind


def _kinds(annotation: Any) -> Iterator[Any]:
    """Yields the alternatives of a type."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _kinds(get_args(annotation)[0])
    elif origin in {Union, UnionType}:
        for one in get_args(annotation):
            yield from _kinds(one)
    else:
        yield annotation


def results(folder: Path) -> dict[str, bytes]:
    """Returns what a job wrote, without the copies of its configuration and its log.

    `policy.json` repeats the settings of the model, the policy and the windows; what else is in it
    counts.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or name.startswith(".hydra/") or name in {"config.yaml", "cfx.log"}:
            continue
        content = path.read_bytes()
        if path.name == "policy.json":
            policy = json.loads(content)
            for copied in ("policy", "model", "windows"):
                policy.pop(copied, None)
            content = json.dumps(policy, sort_keys=True).encode()
        found[name] = content
    if not found:
        raise ConfigError(f"{folder}: the job wrote nothing")
    return found
