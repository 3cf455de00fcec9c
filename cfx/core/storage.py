"""Files behind URLs such as `s3://bucket/file` and `gs://bucket/file`, read and written by fsspec.

fsspec and its packages (s3fs, gcsfs, adlfs) know where credentials are; nothing of them is kept.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cfx.core.distributions import install_line
from cfx.core.files import atomic_write
from cfx.errors import (
    CfxError,
    ConfigError,
    DataError,
    NotInstalledError,
    first_line,
    without_passwords,
)

__all__ = [
    "is_url",
    "local_folder",
]
"""What plugins may use, as `cfx.plugin.storage`."""


_PACKAGES = {
    "s3": "s3fs",
    "s3a": "s3fs",
    "gs": "gcsfs",
    "gcs": "gcsfs",
    "abfs": "adlfs",
    "http": "aiohttp",
    "https": "aiohttp",
}
"""Packages that fsspec needs for kinds of URLs."""

_VERSIONS = ("ETag", "etag", "md5Hash", "content_md5", "mtime", "LastModified", "updated")
"""Names of the version or time of a file in stores, the most reliable first."""

_CHARACTERS_OF_A_SCHEME = r"[a-zA-Z][a-zA-Z0-9+.-]+://"


def is_url(value: object) -> bool:
    """Says whether a value is a URL and no path of this machine."""
    return isinstance(value, str) and re.match(_CHARACTERS_OF_A_SCHEME, value) is not None


def path_or_url(written: str | Path) -> Path | str:
    """Returns a URL as it is, and everything else as a path; `~` is the user's home.

    Raises:
        ConfigError: nothing is written.
    """
    if not str(written).strip():
        raise ConfigError("the name of the file is empty; give a path or URL")
    return str(written) if is_url(str(written)) else Path(written).expanduser()


def local_copies(url: str) -> list[Path]:
    """Returns copies of the files that a URL or a pattern stands for, sorted by name.

    A copy is kept, in `~/.cache/cfx/data` or `CFX_DATA_CACHE`, as long as the file behind the URL
    is the same.

    Raises:
        DataError: there is none, or it cannot be read.
    """
    with _explained(f"data.path={url}"):
        system, path = _opened(url)
        paths = [path]
        if not set("*?[").isdisjoint(path):
            paths = sorted(system.glob(path))
        if not paths:
            raise DataError(f"data.path={url}: no file matches this pattern")
        return [_copy(system, file) for file in paths]


def local_folder(url: str) -> Path:
    """Returns a copy of the folder behind a URL, with all that lies below it.

    A copy is kept, as those of recordings are, as long as nothing in the folder has changed.

    Raises:
        DataError: there is none, or it cannot be read.
    """
    with _explained(url):
        system, path = _opened(url)
        files = {}
        for name, about in system.find(path, detail=True).items():
            inside = str(name).removeprefix(path).strip("/")
            if inside and not str(name).endswith("/"):
                files[inside] = about
        if not files:
            raise DataError(f"{url}: there is no such folder, or nothing in it")
        marks = [f"{name} {_version(about)}" for name, about in sorted(files.items())]
        home = _kept(f"{path} {marks}")
        copy = home / path.rpartition("/")[2]
        if not copy.is_dir():
            _copy_files(system, path, list(files), copy)
        return copy


def state(url: str) -> list[str]:
    """Returns what changes when a file behind a URL or a pattern does.

    Raises:
        DataError: it cannot be looked at.
    """
    with _explained(f"data.path={url}"):
        system, path = _opened(url)
        return [_version(system.info(file)) for file in sorted(system.glob(path))]


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
            with _os_errors():
                content: bytes = self._system.cat_file(f"{self._path}/{name}")
        except FileNotFoundError:
            return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Writes a file, atomically in object stores.

        Raises:
            OSError: it cannot be written.
        """
        with _os_errors():
            self._system.pipe_file(f"{self._path}/{name}", content)

    def put(self, name: str, file: Path) -> None:
        """Writes a copy of a file of this machine, as `write` does.

        Raises:
            OSError: the one cannot be read, or the other cannot be written.
        """
        with _os_errors():
            self._system.put_file(str(file), f"{self._path}/{name}")

    def names(self) -> list[str]:
        """Returns the names of all files, here and below, sorted.

        Raises:
            OSError: the store cannot be read.
        """
        with _os_errors():
            self._system.invalidate_cache()
            paths = self._system.find(self._path)
        return sorted(str(name).removeprefix(self._path).strip("/") for name in paths)

    def remove(self, name: str) -> None:
        """Removes a file; nothing happens where there is none.

        Raises:
            OSError: it cannot be removed.
        """
        with suppress(FileNotFoundError), _os_errors():
            self._system.rm_file(f"{self._path}/{name}")


def _opened(url: str) -> tuple[Any, str]:
    """Returns a file system and the path in it."""
    import fsspec

    scheme = url.partition("://")[0].lower()
    package = _PACKAGES.get(scheme)
    if package is not None and importlib.util.find_spec(package) is None:
        raise NotInstalledError(f"{url} needs the package {package}: {install_line(package)}")
    try:
        system, path = fsspec.core.url_to_fs(url)
    except ValueError as error:
        raise CfxError(f"{url}: {error}") from error
    system.invalidate_cache()  # listings of before
    return system, str(path)


def _copy(system: Any, path: str) -> Path:
    copy = _kept(f"{path} {_version(system.info(path))}") / path.rpartition("/")[2]
    if not copy.is_file():
        copy.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(copy) as partial:
            system.get_file(path, str(partial))
    return copy


def _copy_files(system: Any, path: str, names: list[str], copy: Path) -> None:
    """Copies files below a path to a folder, which appears whole."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    partial = copy.with_name(f".{secrets.token_hex(8)}")
    try:
        for name in names:
            target = partial / name
            if not target.resolve().is_relative_to(partial.resolve()):
                raise DataError(f"{path}/{name}: leads out of its folder, and is not copied")
            target.parent.mkdir(parents=True, exist_ok=True)
            system.get_file(f"{path}/{name}", str(target))
        with suppress(OSError):  # another process was faster
            partial.rename(copy)
        if not copy.is_dir():
            raise OSError(f"{copy} cannot be made")
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _kept(what: str) -> Path:
    """Returns the folder of this machine's copy of something, which need not be there."""
    home = os.environ.get("CFX_DATA_CACHE") or "~/.cache/cfx/data"
    return Path(home).expanduser() / hashlib.sha256(what.encode()).hexdigest()[:16]


def _version(about: Any) -> str:
    """Returns a file's size and version, which change when it does."""
    for name in _VERSIONS:
        if name in about:
            mark = str(about[name]).strip('"')
            return f"{about['size']} {mark}"
    return str(about["size"])


@contextmanager
def _os_errors() -> Iterator[None]:
    """Turns what object stores raise besides OSError, such as missing credentials, into one."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # each store raises errors of its own
        raise OSError(f"{type(error).__name__}: {first_line(error)}") from error


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turns what object stores raise into a sentence about what was asked for."""
    try:
        yield
    except CfxError:
        raise
    except FileNotFoundError:
        raise DataError(f"{without_passwords(what)}: no such file") from None
    except Exception as error:  # each store raises errors of its own
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise DataError(f"{without_passwords(what)}: cannot be read ({reason})") from error
