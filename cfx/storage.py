"""Files behind URLs such as `s3://bucket/file` and `gs://bucket/file`, read and written by fsspec.

fsspec and its packages (s3fs, gcsfs, adlfs) know where credentials are; nothing of them is kept.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cfx.errors import CfxError, DataError, without_passwords
from cfx.extras import install_line
from cfx.files import atomic_write

_PACKAGES = {"s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs"}
"""What fsspec needs for a kind of URL, where it is not fsspec itself."""

_VERSIONS = ("ETag", "etag", "md5Hash", "content_md5", "mtime", "LastModified", "updated")
"""What stores call the version of a content, or its time, the surest first."""

_CHARACTERS_OF_A_SCHEME = r"[a-zA-Z][a-zA-Z0-9+.-]+://"


def is_url(value: object) -> bool:
    """Says whether a value is a URL and no path of this machine."""
    return isinstance(value, str) and re.match(_CHARACTERS_OF_A_SCHEME, value) is not None


def local_copies(url: str) -> list[Path]:
    """Returns copies of the files that a URL or a pattern stands for, sorted by name.

    A copy is kept, in `~/.cache/cfx/data` or `CFX_DATA_CACHE`, as long as the file behind the URL
    is the same.

    Raises:
        DataError: there is none, or it cannot be read.
    """
    with _explained(url):
        system, path = _opened(url)
        found = [path]
        if any(mark in path for mark in "*?["):
            found = sorted(system.glob(path))
        if not found:
            raise DataError(f"data.path={url}: no file matches this pattern")
        return [_copy(system, one) for one in found]


def state(url: str) -> list[str]:
    """Returns what changes when a file behind a URL or a pattern does.

    Raises:
        DataError: it cannot be looked at.
    """
    with _explained(url):
        system, path = _opened(url)
        return [_version(system, one) for one in sorted(system.glob(path))]


class RemoteFolder:
    """Files below a URL, each written whole.

    Args:
        url: of the folder.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._system, self._path = _opened(self.url)

    def read(self, name: str) -> bytes | None:
        """Returns a file, or None if there is none.

        Raises:
            OSError: it cannot be read.
        """
        try:
            content: bytes = self._system.cat_file(f"{self._path}/{name}")
        except FileNotFoundError:
            return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Writes a file: object stores show it whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        self._system.pipe_file(f"{self._path}/{name}", content)


def _opened(url: str) -> tuple[Any, str]:
    """Returns a file system and the path in it.

    Raises:
        CfxError: its package is not installed, or nobody knows such URLs.
    """
    import fsspec

    scheme = url.partition("://")[0].lower()
    package = _PACKAGES.get(scheme)
    if package is not None and importlib.util.find_spec(package) is None:
        raise CfxError(f"{url} needs the package {package}: {install_line(package)}")
    try:
        system, path = fsspec.core.url_to_fs(url)
    except ValueError as error:
        raise CfxError(f"{url}: {error}") from error
    system.invalidate_cache()  # listings of before
    return system, str(path)


def _copy(system: Any, path: str) -> Path:
    kept = os.environ.get("CFX_DATA_CACHE") or "~/.cache/cfx/data"
    mark = hashlib.sha256(f"{path} {_version(system, path)}".encode()).hexdigest()[:16]
    copy = Path(kept).expanduser() / mark / path.rpartition("/")[2]
    if not copy.is_file():
        copy.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(copy) as partial:
            system.get_file(path, str(partial))
    return copy


def _version(system: Any, path: str) -> str:
    """Returns what changes when a file does: its size, and what its store calls its version."""
    about = system.info(path)
    for name in _VERSIONS:
        if name in about:
            mark = str(about[name]).strip('"')
            return f"{about['size']} {mark}"
    return str(about["size"])


@contextmanager
def _explained(url: str) -> Iterator[None]:
    """Turns what object stores raise into a sentence."""
    try:
        yield
    except CfxError:
        raise
    except FileNotFoundError:
        raise DataError(f"data.path={without_passwords(url)}: no such file") from None
    except Exception as error:  # each store raises errors of its own
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise DataError(
            f"data.path={without_passwords(url)}: cannot be read ({type(error).__name__}: {first})"
        ) from error
