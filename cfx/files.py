"""Paths that users write, and files that appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from cfx.errors import OutputError


def absolute(value: Any) -> Path:
    """Returns an absolute path; `~` is the user's home.

    A later change of the working directory then changes nothing.

    Raises:
        PydanticCustomError: it is no path.
    """
    # "???" is how a config file says that a value is missing.
    if value is None or str(value).strip() in {"", "???"}:
        raise PydanticCustomError("missing", "a value is required")
    if not isinstance(value, str | Path):
        raise PydanticCustomError("path", "write a path")
    return Path(value).expanduser().absolute()


FilePath = Annotated[Path, BeforeValidator(absolute)]
"""A path that a user writes."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Gives the block a temporary file beside `path`, which takes its place if the block ends well.

    The temporary file has the same suffixes. If the block fails, nothing of it is left and an
    earlier file stays as it was.

    Raises:
        OSError: the place cannot be written.
    """
    partial = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_output(path: Path, text: str, what: str) -> None:
    """Writes a text where the user's `--output` names it, whole; makes its folders.

    Args:
        path: the file; what was there is replaced once the new text is complete.
        text: of the file.
        what: it is, for the error: "the report".

    Raises:
        OutputError: the place cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder", str(path))
        with atomic_write(path) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: {what} cannot be written ({error.strerror or error}); name another --output"
        ) from error


def remove_leftovers(folder: Path) -> None:
    """Removes temporary files of `atomic_write` whose processes have ended, here and below.

    Raises:
        OSError: one cannot be removed.
    """
    for path in sorted(folder.rglob(".*.*")):
        number = path.name[1:].partition(".")[0]
        if path.is_file() and number.isdecimal() and not _runs(int(number)):
            path.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes a JSON file, whole.

    Raises:
        OSError: the place cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
