"""The folder of a job: how it begins, how its files appear whole or not at all, and its copy."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from cfx.core.files import atomic_write, remove_leftovers
from cfx.core.job_folder import optional, parse_yaml, read_yaml_list
from cfx.core.storage import RemoteFolder
from cfx.errors import ConfigError, DataError, OutputError, without_passwords
from cfx.results.config import JobConfig

log = logging.getLogger(__name__)

CONFIG = "config.yaml"

DATA = "data.json"

METRICS = "metrics.json"
"""The file that is written last: a folder that has it is complete."""


def typed_overrides(folder: Path) -> tuple[str, ...] | None:
    """Returns what was typed for a job, without passwords; None if its folder does not say it."""
    typed = optional(folder / ".hydra" / "overrides.yaml", read_yaml_list)
    if typed is None:
        return None
    return tuple(without_passwords(str(override)) for override in typed)


def begin(folder: Path, config: JobConfig) -> None:
    """Makes a job's folder, if it is not there, and writes the job's configuration into it.

    Where the folder holds an earlier job's results, these stay as they are until the new ones are
    there, so that the folder never mixes two jobs.

    Raises:
        OutputError: the folder cannot be made, or not be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the output folder {folder}: {error.strerror};"
            " name a folder that can be written (of a job: hydra.run.dir=FOLDER)"
        ) from error
    with writing(folder):
        remove_leftovers(folder)
        if not (folder / METRICS).is_file():
            write_config(folder, config)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Says in one sentence that the file system refuses what the block writes."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot write into {folder}: {error.strerror or error};"
            " the calibration is cached, so run again"
        ) from error


def write_config(folder: Path, config: JobConfig) -> None:
    """Writes the resolved configuration."""
    values = config.model_dump(mode="json")
    with atomic_write(folder / CONFIG) as temporary:
        temporary.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def read_config(path: Path) -> JobConfig:
    """Reads a job's configuration.

    Raises:
        DataError: there is none that this version knows.
    """
    try:
        return JobConfig.of(parse_yaml(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror}); give the output folder that a job printed"
        ) from None
    except (ValueError, ConfigError) as error:
        raise DataError(f"{path} is no configuration of this version of cfx: {error}") from None


class Upload:
    """The copy of a job's folder behind a URL.

    At first it has the configuration alone, so that a store that cannot be written is known at
    once. Results of an earlier job there stay as they are until the new ones come.

    Raises:
        CfxError: nobody knows such URLs, what they need is not installed, or the store cannot be
            read or written.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url = f"{url.rstrip('/')}/{place_of(folder)}"
        self._folder = folder
        self._remote = RemoteFolder(self.url)
        try:
            if self._remote.read(METRICS) is None:
                self._remote.put(CONFIG, folder / CONFIG)
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
        names = []
        for path in sorted(self._folder.rglob("*")):
            is_temporary = path.name.startswith(".") and "@" in path.name
            is_lock = path.name in {".lock", ".lock.lease"}  # of this machine alone
            if path.is_file() and not is_lock and not is_temporary and path.name != METRICS:
                names.append(path.relative_to(self._folder).as_posix())
        try:
            there = set(self._remote.names())
            if {METRICS, CONFIG} <= there:  # a job's; anything else is not ours to remove
                self._remote.remove(METRICS)
                for name in there - {METRICS, *names}:
                    self._remote.remove(name)
            for name in (*names, METRICS):
                self._remote.put(name, self._folder / name)
            log.info("The job's folder was copied to %s", self.url)
        except OSError as error:
            raise OutputError(
                f"the job's results lie in {self._folder}, but cannot be copied to"
                f" {self.url} ({error}); the calibration is cached, so run again"
            ) from error


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
