"""Reads the files of a job's folder; one sentence says what is damaged."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from cfx.core.errors import DataError
from cfx.core.job_folder import parse_json, parse_yaml, unreadable

T = TypeVar("T")

_FOLDERS = re.compile(r"(?<![\w.~:/-])/(?:[^/\s'\",\]]+/)+")
_OF_DATABASE = re.compile(r"(sqlite:///)/(?:[^/\s'\",\]]+/)+")
_PASSWORD = re.compile(r"(://[^/@\s:]*):[^/@\s]+@")


def optional(path: Path, read: Callable[[Path], T]) -> T | None:
    """Returns what a file holds; None if there is no such file."""
    return read(path) if path.exists() else None


def read_metrics(path: Path) -> dict[str, float]:
    """Reads `metrics.json`; NaN where a metric is not defined.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    values = {}
    try:
        for name, value in read_json(path).items():
            values[str(name)] = math.nan if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path} is damaged: a metric is no number ({error})") from error
    return values


def read_json(path: Path) -> dict[str, Any]:
    """Reads a mapping.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    return _mapping(path, parse_json)


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a mapping; errors as of `read_json`."""
    return _mapping(path, parse_yaml)


def read_yaml_list(path: Path) -> list[Any]:
    """Reads a list; what is none is an empty one. Errors as of `read_json`."""
    content = _parsed(path, parse_yaml)
    return list(content) if isinstance(content, list) else []


def _mapping(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    content = _parsed(path, parse)
    if not isinstance(content, dict):
        raise DataError(f"{path} is damaged: it holds no mapping of names to values")
    return content


def _parsed(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def public(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values without passwords of database addresses, as they may be passed on."""
    return {key: _clean(value) for key, value in values.items()}


def _clean(value: Any) -> Any:
    if isinstance(value, Mapping):
        return public(value)
    if isinstance(value, list):
        return [_clean(part) for part in value]
    if isinstance(value, str):
        return without_password(value)
    return value


def without_folders(text: str) -> str:
    """Returns a text without the folders of absolute paths, which nobody else has."""
    return _OF_DATABASE.sub(r"\1", _FOLDERS.sub("", text))


def without_password(text: str) -> str:
    """Returns a text with three stars for passwords in `postgresql://name:password@host`."""
    return _PASSWORD.sub(r"\1:***@", text)
