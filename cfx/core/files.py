"""Paths of users, and files that are written atomically."""

from __future__ import annotations

import json
import os
import re
import secrets
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import psutil  # type: ignore[import-untyped]  # it ships no types
from filelock import BaseFileLock, FileLock, SoftFileLease
from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from cfx.errors import OutputError

__all__ = [
    "atomic_write",
    "path_override",
    "write_json",
    "write_output",
]
"""What plugins may use, as `cfx.plugin.files`."""


_DAY_S = 86400.0
"""Age in seconds, since the last write, at which another machine's temporary file is removed."""

_TEMPORARY = re.compile(r"\.(?P<process>\d+)@(?P<host>[\w-]*)-[0-9a-f]{8}\..")
"""Names of temporary files: process, machine, and random digits."""


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

IN_MEMORY = "<in memory>"
"""What a configuration calls a data frame, or a policy that was not saved, in place of its path."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Gives the block a temporary file beside `path`, which takes its place if the block ends well.

    The temporary file has the same suffixes, and is this block's own: other threads, processes and
    machines may write the same file at the same time. If the block fails, nothing of it is left and
    an earlier file stays as it was.

    Raises:
        OSError: the place cannot be written.
    """
    prefix = f"{os.getpid()}@{_host()}-{secrets.token_hex(4)}"
    partial = path.with_name(f".{prefix}.{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_output(path: Path, content: str | bytes, what: str) -> None:
    """Writes a file where the user's `--output` names it, whole; makes its folders.

    Args:
        path: the file; what was there is replaced once the new content is complete.
        content: of the file; a text is written in UTF-8.
        what: it is, for the error: "the report".

    Raises:
        OutputError: the place cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder", str(path))
        with atomic_write(path) as partial:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise OutputError(
            f"{path}: {what} cannot be written ({error.strerror or error}); name another --output"
        ) from error


def remove_leftovers(folder: Path) -> None:
    """Removes temporary files of `atomic_write` whose processes have ended, here and below.

    Processes of other machines are unknown here: their files are removed when they are a day old.

    Raises:
        OSError: one cannot be removed.
    """
    for path in sorted(folder.rglob(".*@*.*")):
        match = _TEMPORARY.match(path.name)
        if match is not None and path.is_file() and _is_left_over(path, match):
            path.unlink(missing_ok=True)


def _is_left_over(path: Path, match: re.Match[str]) -> bool:
    if match["host"] == _host():
        return not _runs(int(match["process"]))
    return time.time() - path.stat().st_mtime > _DAY_S


def _host() -> str:
    """Returns this machine's name, as far as it is fit for the name of a file."""
    return re.sub(r"[^\w-]", "", socket.gethostname())[:32]


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


_PLAIN = re.compile(r"[\w./+:-]+", re.ASCII)
"""Values that Hydra's grammar takes as they are."""


def path_override(key: str, path: Path | str) -> str:
    """Returns the override that gives a setting a path or URL, in quotes where it needs them."""
    return f"{key}={quoted(str(path))}"


def quoted(text: str, *, always: bool = False) -> str:
    """Returns a text as a value in Hydra's grammar, in quotes where its signs ask for them.

    Args:
        text: the value.
        always: in quotes whatever its signs are.
    """
    if not always and _PLAIN.fullmatch(text):
        return text
    # Backslashes count as such in a quoted value only before a quote.
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    ending = re.search(r"\\*$", escaped)
    assert ending is not None
    return f"'{escaped}{ending[0]}'"


LEASE_S = 60.0
"""Seconds after which a lease that is not renewed is free."""

_SHARED = ("nfs", "cifs", "smb", "lustre", "gpfs", "beegfs", "ceph", "afs", "9p", "panfs", "wekafs")
"""Prefixes of the types of network file systems."""

_SHARED_IN_USER_SPACE = ("sshfs", "gluster", "s3fs", "gcsfuse", "cvmfs", "juicefs")
"""Parts of the type of network file systems in user space, after `fuse.`."""


def lock_for(path: Path, *, timeout: float = -1) -> BaseFileLock:
    """Returns the lock whose file is `path`, not yet held.

    Args:
        path: beside what it guards.
        timeout: how long `acquire` waits, s; -1: for ever.
    """
    if is_shared(path.parent):
        lease = path.with_name(f"{path.name}.lease")
        return SoftFileLease(lease, lease_duration=LEASE_S, timeout=timeout)
    return FileLock(path, timeout=timeout)


def is_shared(folder: Path) -> bool:
    """Says whether a folder lies on a network file system.

    `CFX_SHARED_STORAGE=1` makes it true of every folder: for file systems not recognised by name.
    """
    if os.environ.get("CFX_SHARED_STORAGE", "") not in {"", "0"}:
        return True
    kind = _file_system(folder)
    if kind.startswith("fuse."):
        return any(name in kind for name in _SHARED_IN_USER_SPACE)
    return kind.startswith(_SHARED)


def _file_system(folder: Path) -> str:
    """Returns the type of the file system on which a folder lies, "" where it is unknown."""
    best, kind = "", ""
    for mount in psutil.disk_partitions(all=True):
        place = mount.mountpoint
        if folder.absolute().is_relative_to(place) and len(place) >= len(best):
            best, kind = place, mount.fstype
    return kind
