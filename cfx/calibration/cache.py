"""A cache of calibration results, by content.

An entry's name is the SHA-256 of everything that the result depends on, so a hit is always the right answer and nothing ever
needs to be invalidated. Entries are NumPy archives read without pickle; each appears whole or not at all, and a damaged one is
computed again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.errors import OutputError
from cfx.files import whole

log = logging.getLogger(__name__)

Arrays = dict[str, NDArray[Any]]


def content_key(parts: Mapping[str, Any]) -> str:
    """Returns the SHA-256 of a JSON-able description."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


class Cache:
    """Named arrays by content key, in one folder; `folder=None` remembers nothing."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def get(self, key: str) -> Arrays | None:
        """Returns the entry, or None if there is none or it is damaged."""
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        try:
            # A file of our own: NumPy leaves the one it opens behind when the archive is damaged.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError):
            log.warning("The cached calibration %s is damaged; it is computed again.", path)
            return None

    def put(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Stores an entry.

        Raises:
            OutputError: the folder cannot be written.
        """
        path = self._path(key)
        if path is None:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole(path) as temporary:
                np.savez(temporary, **arrays)  # type: ignore[arg-type]  # the stubs take every name for `allow_pickle`
        except OSError as error:
            raise OutputError(
                f"cannot write the calibration cache {self.folder}: {error.strerror}; set cache.folder to a folder that can"
                f" be written,"
                " or cache.enabled=false"
            ) from error

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / key[:2] / f"{key}.npz"
