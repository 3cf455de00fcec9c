"""A cache of calibration results, by content.

An entry's name is the SHA-256 of everything that the result depends on. A hit is therefore always
right, and nothing ever needs to be invalidated. An entry is a line with a mark and the checksum of
what follows, a NumPy archive that is read without pickle. It appears whole or not at all. One that
is damaged, or that something else wrote, is computed again: nothing of it is looked at before its
checksum is right.

Processes that need the same entries share the work. Each claims what it is about to compute by a
file lock, and comes back later to what another process has claimed. The operating system frees a
claim when its process ends, however it ends.
"""

from __future__ import annotations

import hashlib
import io
import logging
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import Timeout
from numpy.typing import NDArray

from cfx.core.files import atomic_write, lock_for
from cfx.core.storage import RemoteFolder
from cfx.errors import OutputError

log = logging.getLogger(__name__)

Arrays = dict[str, NDArray[Any]]
"""The arrays of an entry, by name."""

_SHARDS = 32
"""Shards in which processes claim the entries of one calibration."""

_MARK = b"cfx calibration 1 "
"""First bytes of an entry; the number counts layouts."""

_LARGEST = 1 << 30
"""Bytes: no calibration of one pair or group is larger."""

_POLL_S = 0.2
"""Seconds between two looks at a claim of another process."""


class Cache:
    """Named arrays by content key, in one folder.

    Behind a URL nothing is claimed: object stores have no locks. Processes that need the same entry
    at the same moment then each compute it, and write the same.

    Args:
        folder: of the entries: a path, or the URL of a store; None: nothing is kept.
    """

    def __init__(self, folder: Path | str | None) -> None:
        self.folder: Path | None = None
        self._remote: RemoteFolder | None = None
        if isinstance(folder, str):
            self._remote = RemoteFolder(folder)
        else:
            self.folder = folder

    def get(self, key: str) -> Arrays | None:
        """Returns the entry, or None if there is none or it is damaged."""
        try:
            whole = self._read(key)
            if whole is None:
                return None
            with np.load(io.BytesIO(_checked(whole)), allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError):
            where: str | Path = key
            if self.folder is not None:
                where = self.folder / _name(key)
            log.warning("The cached calibration %s is damaged; it is computed again.", where)
            return None

    def put(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Stores an entry.

        Raises:
            OutputError: the folder cannot be written.
        """
        if self.folder is None and self._remote is None:
            return
        archive = io.BytesIO()
        # NumPy's stubs take every name for `allow_pickle`.
        np.savez(archive, **arrays)  # type: ignore[arg-type]
        content = archive.getvalue()
        whole = _head(content) + content
        try:
            if self._remote is not None:
                self._remote.write(_name(key), whole)
            elif self.folder is not None:
                path = self.folder / _name(key)
                path.parent.mkdir(parents=True, exist_ok=True)
                with atomic_write(path) as temporary:
                    temporary.write_bytes(whole)
        except OSError as error:
            raise self._unwritable(error) from error

    def _read(self, key: str) -> bytes | None:
        """Returns an entry as it lies in its folder, or None if there is none."""
        if self._remote is not None:
            try:
                return self._remote.read(_name(key))
            except OSError as error:
                raise self._unwritable(error) from error
        if self.folder is None:
            return None
        path = self.folder / _name(key)
        if not path.is_file():
            return None
        if path.stat().st_size > _LARGEST:
            raise ValueError("larger than any entry")
        return path.read_bytes()

    def shards(self, keys: Sequence[str], scope: str) -> dict[str, list[int]]:
        """Returns the shards in which entries are claimed: the shard's name -> positions in `keys`.

        Args:
            keys: of the entries.
            scope: what all keys of one calibration have in common. Calibrations without a common
                entry then have no common claim, but for a rare coincidence, which costs a little
                waiting and nothing else.
        """
        shards: dict[str, list[int]] = {}
        for position, key in enumerate(keys):
            number = 0
            if self.folder is not None:
                number = int(key[:8], 16) % _SHARDS
            # Three digits: there are never more than 4096 lock files, however many calibrations the
            # cache sees.
            name = hashlib.sha256(f"{scope} {number}".encode()).hexdigest()[:3]
            shards.setdefault(name, []).append(position)
        return shards

    @contextmanager
    def claim(self, sizes: Mapping[str, int], enough: float) -> Iterator[list[str]]:
        """Claims shards while the block lasts.

        Nothing is claimed while this waits, so there is no deadlock.

        Args:
            sizes: problems in each shard that is wanted; at least one shard.
            enough: no further shard is claimed that would bring the claimed problems above this
                number; at least one shard is always claimed.

        Yields:
            The names of the claimed shards: free ones if there are any, else the first one that
            another process lets go.

        Raises:
            OutputError: the folder cannot be written.
        """
        with ExitStack() as held:
            claimed: list[str] = []
            problems = 0
            for name, size in sizes.items():
                fits = not claimed or problems + size <= enough
                if fits and self._acquire(held, name, wait=False):
                    claimed.append(name)
                    problems += size
            if not claimed:
                first = next(iter(sizes))
                self._acquire(held, first, wait=True)
                claimed.append(first)
            yield claimed

    def _acquire(self, held: ExitStack, name: str, *, wait: bool) -> bool:
        if self.folder is None:
            return True
        lock = lock_for(self.folder / "claims" / f"{name}.lock")
        timeout_s = -1 if wait else 0  # -1: without end
        try:
            Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
            held.enter_context(lock.acquire(timeout=timeout_s, poll_interval=_POLL_S))
        except Timeout:
            return False
        except OSError as error:
            raise self._unwritable(error) from error
        return True

    def _unwritable(self, error: OSError) -> OutputError:
        where: str | Path | None = self.folder
        if self._remote is not None:
            where = self._remote.url
        return OutputError(
            f"cannot write the calibration cache {where}: {error.strerror or error};"
            " set cache.folder to a folder that can be written, or cache.enabled=false"
        )


def first_fit(sizes: Mapping[str, int], enough: int) -> list[list[str]]:
    """Puts shards together as claims would that find all of them free, one claim after the other.

    Args:
        sizes: problems in each shard.
        enough: problems in each claim at most, but for one shard that alone has more.
    """
    left = dict(sizes)
    claims: list[list[str]] = []
    while left:
        claim: list[str] = []
        problems = 0
        for name, size in left.items():
            if not claim or problems + size <= enough:
                claim.append(name)
                problems += size
        for name in claim:
            del left[name]
        claims.append(claim)
    return claims


def _name(key: str) -> str:
    """Returns where an entry lies in its folder."""
    return f"{key[:2]}/{key}.entry"


def _head(content: bytes) -> bytes:
    """Returns the line before an archive."""
    return _MARK + hashlib.sha256(content).hexdigest().encode() + b"\n"


def _checked(whole: bytes) -> bytes:
    """Returns the archive of an entry whose checksum is right.

    Raises:
        ValueError: it is not.
    """
    length = len(_head(b""))
    content = whole[length:]
    if whole[:length] != _head(content):
        raise ValueError("the checksum is wrong")
    return content
