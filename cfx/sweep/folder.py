"""The folder of a sweep: which one a command continues or makes, and the locks that keep others out.

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

from filelock import FileLock, Timeout

from cfx.errors import ConfigError
from cfx.sweep.record import Record

log = logging.getLogger(__name__)

LOCK = ".lock"

_DATED = re.compile(r"\$\{\s*now\s*:")


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Holds a job's folder: the worker of a killed sweep may still be at that job, and is waited for."""
    lock = FileLock(folder / LOCK)
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
) -> tuple[Path, FileLock]:
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
        return _asked_for(wanted, resumable=resumable)
    if resumable:
        found = _left_over(_pattern(configured), command_hash)
        if found is not None:
            return found
    return _fresh(wanted)


def _pattern(folder: str) -> str:
    """Returns the glob of a configured folder: what is interpolated may be anything."""
    before, text = "", folder
    while before != text:
        before, text = text, re.sub(r"\$\{[^${}]*\}", "\0", text)
    return "*".join(glob.escape(part) for part in text.split("\0"))


def _left_over(pattern: str, command_hash: str) -> tuple[Path, FileLock] | None:
    """Returns, locked, the newest sweep of this command that no other process runs, unless it is complete."""
    folders = [Path(path) for path in glob.glob(pattern)]  # noqa: PTH207 - the pattern may be absolute, Path.glob takes none
    known = [
        (record.started, folder)
        for folder in folders
        if (record := Record.read(folder)) is not None
    ]
    for _, folder in sorted(known, reverse=True):
        record = Record.read(folder)
        if record is None or record.command_hash != command_hash:
            continue
        lock = _try_lock(folder)
        if lock is None:
            continue
        record = Record.read(folder)  # it may have come to its end just now
        if record is not None and not record.completed:
            return folder, lock
        lock.release()
        return None
    return None


def _fresh(wanted: Path) -> tuple[Path, FileLock]:
    """Returns a new folder, locked."""
    folder, number = wanted, 1
    while True:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            lock = _try_lock(folder)
            if lock is not None:
                return folder, lock
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")


def _asked_for(folder: Path, *, resumable: bool) -> tuple[Path, FileLock]:
    """Returns the folder that the user named, locked."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = _try_lock(folder)
    if lock is None:
        raise ConfigError(
            f"{folder}: another sweep runs in this folder; wait for it, or choose another hydra.sweep.dir"
        )
    if not resumable and Record.read(folder) is not None:
        lock.release()
        raise ConfigError(
            f"{folder}: holds a sweep already, and hydra.sweep.subdir names its jobs' folders in a way that jobs of another"
            " order would overwrite; end it with -${cfx_job:}, or choose another hydra.sweep.dir"
        )
    return folder, lock


def _try_lock(folder: Path) -> FileLock | None:
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    return lock
