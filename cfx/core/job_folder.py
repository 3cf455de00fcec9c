"""Reads a job's folder as untrusted data; one sentence says what is damaged.

Runs nothing in it, reads nothing outside it, and refuses files that are larger or more deeply
nested than those that a job writes.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from cfx.errors import DataError, first_line, without_passwords

__all__ = [
    "examine",
    "optional",
    "parse_json",
    "parse_yaml",
    "read_json",
    "read_yaml",
    "without_folders",
]
"""What plugins may use, as `cfx.plugin.job_folder`."""


_LARGEST_MB = 256
"""Texts and weights of a job are smaller."""

_BOUNDED = frozenset({".json", ".yaml", ".log", ".safetensors", ".pt"})
"""Files that are read as a whole. Tables are bounded by memory, where they are read."""

_DEPTH = 3
"""Folders below a job's own that hold what it wrote: `policy`, `figures`, `.hydra`."""

_NESTED = 60
"""Lists and mappings within one another; a job writes about six."""


def examine(folder: Path) -> None:
    """Checks what a folder consists of, before anything in it is read.

    Raises:
        DataError: it holds a link that leads out of it, something that is no file, or a text or
            weights that no job writes.
    """
    home = folder.resolve()
    for path in _entries(home):
        try:
            if not path.resolve(strict=True).is_relative_to(home):
                raise DataError(
                    f"{path} is a link that leads out of its folder, and is not followed; copy"
                    " there what it leads to, if you trust it"
                )
            status = path.stat()
        except (OSError, RuntimeError) as error:
            raise DataError(f"{path} is a link that leads nowhere; remove it") from error
        if stat.S_ISDIR(status.st_mode):
            continue
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{path} is no file; a job's folder holds files alone")
        if path.suffix in _BOUNDED and status.st_size > _LARGEST_MB * 2**20:
            raise DataError(
                f"{path} has {status.st_size / 2**20:.0f} MB, at most {_LARGEST_MB} are read;"
                " no job writes so much"
            )


def _entries(home: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(home):
        here = Path(place)
        if len(here.relative_to(home).parts) >= _DEPTH - 1:
            folders.clear()
        for name in (*folders, *files):
            yield here / name


def parse_json(text: str) -> Any:
    """Parses JSON.

    Raises:
        ValueError: it is none, or nested too deeply.
    """
    try:
        values = json.loads(text)
    except RecursionError:
        raise _too_deep() from None
    _check_depth(values)
    return values


def parse_yaml(text: str) -> Any:
    """Parses YAML as plain data: no tag makes an object, and nothing stands for something else.

    Raises:
        ValueError: it is none, has an alias, or is nested too deeply.
    """
    try:
        # The loader is PyYAML's safe one, without aliases.
        values = yaml.load(text, Loader=_PlainLoader)  # noqa: S506
    except yaml.YAMLError as error:
        raise ValueError(first_line(error)) from error
    except RecursionError:
        raise _too_deep() from None
    _check_depth(values)
    return values


def unreadable(path: Path, error: Exception) -> DataError:
    """Returns the error that a file of a job cannot be read, with the first line of the reason."""
    reason = first_line(error)
    return DataError(f"{path} cannot be read ({reason}); run the job again, or leave it out")


class _PlainLoader(yaml.SafeLoader):
    """YAML's safe loader; an alias, with which a short text can mean a huge one, is an error."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "an alias is not read", None)
        return super().compose_node(parent, index)


def _check_depth(values: Any) -> None:
    level = [values]
    for _ in range(_NESTED):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.values()
            elif isinstance(value, list):
                below += value
        if not below:
            return
        level = below
    raise _too_deep()


def _too_deep() -> ValueError:
    return ValueError(f"it is nested more than {_NESTED} levels deep")


T = TypeVar("T")

_FOLDERS = re.compile(r"(?<![\w.~:/-])/(?:[^/\s'\",\]]+/)+")
_OF_DATABASE = re.compile(r"(sqlite:///)/(?:[^/\s'\",\]]+/)+")


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


def _parsed(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def _mapping(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    content = _parsed(path, parse)
    if not isinstance(content, dict):
        raise DataError(f"{path} is damaged: it holds no mapping of names to values")
    return content


def public(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values without passwords of database addresses, as they may be passed on."""
    return {key: _clean(value) for key, value in values.items()}


def _clean(value: Any) -> Any:
    if isinstance(value, Mapping):
        return public(value)
    if isinstance(value, list):
        return [_clean(part) for part in value]
    if isinstance(value, str):
        return without_passwords(value)
    return value


def without_folders(text: str) -> str:
    """Returns a text without the folders of absolute paths, which nobody else has."""
    return _OF_DATABASE.sub(r"\1", _FOLDERS.sub("", text))
