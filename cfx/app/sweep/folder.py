"""The folder of a sweep: which one a command continues or makes, and the locks around it.

A folder and a job are used by one process at a time. The operating system frees their locks when
the process ends, however it ends.
"""

from __future__ import annotations

import contextlib
import glob
import logging
import re
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, Timeout

from cfx.app.sweep.record import Record
from cfx.core.errors import ConfigError
from cfx.core.locks import lock_for

log = logging.getLogger(__name__)

LOCK = ".lock"
"""File that a process locks in the folder of a sweep or a job while it works there."""

_DATED = re.compile(r"\$\{\s*now\s*:")
"""A configured folder that holds the time: no two sweeps share it."""


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Holds a job's folder.

    The worker of a sweep that was killed may still run that job; this process then waits for it.
    """
    lock = lock_for(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        log.info("%s: another process runs this job; waiting for it.", folder)
        lock.acquire(poll_interval=0.2)
    try:
        yield
    finally:
        lock.release()


def find_folder(
    configured: str, wanted: Path, command_hash: str, *, resumable: bool
) -> tuple[Path, BaseFileLock]:
    """Returns the folder of a sweep, locked: one that is not complete yet, or a new one.

    Args:
        configured: the folder as it stands in the configuration, with its interpolations.
        wanted: the same, resolved.
        command_hash: see `Record.command_hash`.
        resumable: the folders of its jobs are named by what the jobs are.

    Raises:
        ConfigError: another sweep uses the folder that was asked for.
        OSError: the folder cannot be made.
    """
    if not _DATED.search(configured):
        return _named_folder(wanted, resumable=resumable)
    if resumable:
        found = _incomplete_folder(_pattern(configured), command_hash)
        if found is not None:
            return found
    return _new_folder(wanted)


def _pattern(folder: str) -> str:
    """Returns the glob of a configured folder: what is interpolated may be anything."""
    text = folder
    while True:
        shorter = re.sub(r"\$\{[^${}]*\}", "\0", text)  # innermost interpolations first
        if shorter == text:
            break
        text = shorter
    return "*".join(glob.escape(part) for part in text.split("\0"))


def _incomplete_folder(pattern: str, command_hash: str) -> tuple[Path, BaseFileLock] | None:
    """Returns the newest sweep of this command that no other process runs, locked.

    None if there is no such sweep, or if it is complete.
    """
    candidates = []
    for path in glob.glob(pattern):  # noqa: PTH207 - the pattern may be absolute, Path.glob takes none
        record = Record.read(Path(path))
        if record is not None and record.command_hash == command_hash:
            candidates.append((record.started, Path(path)))
    for _, folder in sorted(candidates, reverse=True):
        lock = _try_lock(folder)
        if lock is None:
            continue
        record = Record.read(folder)  # it may have come to its end just now
        if record is not None and not record.completed:
            return folder, lock
        lock.release()
        return None
    return None


def _new_folder(wanted: Path) -> tuple[Path, BaseFileLock]:
    """Returns a new folder, locked."""
    folder = wanted
    number = 1
    while True:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            lock = _try_lock(folder)
            if lock is not None:
                return folder, lock
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")


def _named_folder(folder: Path, *, resumable: bool) -> tuple[Path, BaseFileLock]:
    """Returns the folder that the user named, locked."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = _try_lock(folder)
    if lock is None:
        raise ConfigError(
            f"{folder}: another sweep runs in this folder;"
            " wait for it, or choose another hydra.sweep.dir"
        )
    if not resumable and Record.read(folder) is not None:
        lock.release()
        raise ConfigError(
            f"{folder}: holds a sweep already, and hydra.sweep.subdir names its jobs' folders in a"
            " way that jobs of another order would overwrite; end it with -${cfx_job:},"
            " or choose another hydra.sweep.dir"
        )
    return folder, lock


def _try_lock(folder: Path) -> BaseFileLock | None:
    """Returns the lock of a folder, held by this process; None if another one holds it."""
    lock = lock_for(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    return lock
