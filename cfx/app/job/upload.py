"""The copy of a job's folder behind a URL, such as `s3://bucket/jobs`.

The job writes its own folder on this machine, and is done when that was copied. `metrics.json`, by
which a finished job is known, is copied last.
"""

from __future__ import annotations

import logging
from pathlib import Path

from cfx.app.job.output import METRICS
from cfx.core.errors import OutputError
from cfx.core.storage import RemoteFolder

log = logging.getLogger(__name__)

_CONFIG = "config.yaml"

_LEFT_OUT = frozenset({".lock", ".lock.lease"})
"""Files that mean something on this machine alone."""


class Upload:
    """Copies a job's folder.

    Args:
        url: what `output.url` says.
        folder: of the job.

    Raises:
        CfxError: nobody knows such URLs, or what they need is not installed.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url = f"{url.rstrip('/')}/{place_of(folder)}"
        self._folder = folder
        self._remote = RemoteFolder(self.url)

    @classmethod
    def of(cls, url: str | None, folder: Path) -> Upload | None:
        """Returns the copy that has begun; None without a URL.

        Raises:
            CfxError: nobody knows such URLs, or the store cannot be read or written.
        """
        if url is None:
            return None
        upload = cls(url, folder)
        upload.begin()
        return upload

    def begin(self) -> None:
        """Copies the configuration, so that a store that cannot be written is known at once.

        Results of an earlier job there stay as they are until the new ones come.

        Raises:
            OutputError: the store cannot be read or written.
        """
        try:
            if self._remote.read(METRICS) is None:
                self._remote.put(_CONFIG, self._folder / _CONFIG)
        except OSError as error:
            raise OutputError(
                f"cannot write to {self.url} ({error}); set output.url to a place"
                " that can be written"
            ) from error

    def finish(self) -> None:
        """Copies all files of the job; those that an earlier job left there go.

        Raises:
            OutputError: the store cannot be written.
        """
        try:
            self._copy()
            log.info("The job's folder was copied to %s", self.url)
        except OSError as error:
            raise OutputError(
                f"the job's results lie in {self._folder}, but cannot be copied to"
                f" {self.url} ({error}); the calibration is cached, so run again"
            ) from error

    def _copy(self) -> None:
        names = self._names()
        there = self._remote.names()
        if {METRICS, _CONFIG} <= set(there):  # a job's; anything else is not ours to remove
            self._remote.remove(METRICS)
            for name in set(there) - set(names):
                self._remote.remove(name)
        for name in names:
            if name != METRICS:
                self._remote.put(name, self._folder / name)
        self._remote.put(METRICS, self._folder / METRICS)

    def _names(self) -> list[str]:
        """Returns the names of the job's files, without those that are being written."""
        names = []
        for path in sorted(self._folder.rglob("*")):
            is_temporary = path.name.startswith(".") and "@" in path.name
            if path.is_file() and path.name not in _LEFT_OUT and not is_temporary:
                names.append(path.relative_to(self._folder).as_posix())
        return names


def place_of(folder: Path) -> str:
    """Returns where a job's folder is copied to, below the URL: its path from `outputs/` on.

    Elsewhere it is its name, in a sweep after the sweep's.
    """
    parts = folder.absolute().parts
    if "outputs" in parts[:-1]:
        last = len(parts) - 1 - parts[::-1].index("outputs")
        return "/".join(parts[last + 1 :])
    if (folder.parent / "sweep.json").is_file():
        return "/".join(parts[-2:])
    return parts[-1]
