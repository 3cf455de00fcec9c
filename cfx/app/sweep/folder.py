"""The folder of a sweep: which one a command continues or makes, its locks, and its records.

A folder and a job are used by one process at a time. The operating system frees their locks when
the process ends, however it ends. Hashes of what was asked for say when two commands are the same
sweep, and two jobs the same job; importing this module makes `${cfx_job:}` known to OmegaConf.
"""

from __future__ import annotations

import contextlib
import glob
import json
import logging
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from filelock import BaseFileLock, Timeout
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from cfx.core.component import content_key
from cfx.core.files import lock_for, write_json
from cfx.core.storage import is_url, state
from cfx.errors import CfxError, ConfigError, DataError

if TYPE_CHECKING:
    from cfx.evaluation.metrics.base import MetricInfo

log = logging.getLogger(__name__)

LOCK = ".lock"
"""File that a process locks in the folder of a sweep or a job while it works there."""

_DATED = re.compile(r"\$\{\s*now\s*:")
"""A configured folder that holds the time: no two sweeps share it."""


STATUS = "outcome.json"
"""The marker in a job's folder; written whole and last."""

RECORD = "sweep.json"
"""Says in a sweep's folder what the sweep is."""

R = TypeVar("R")


def _read(kind: Callable[..., R], path: Path, words: str) -> R | None:
    """Returns a record, whose tuple is called `words`; None if there is none that can be read."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        return kind(**{**values, words: tuple(values[words])})
    except (OSError, ValueError, TypeError, KeyError):
        return None


@dataclass(frozen=True)
class JobStatus:
    """How a job of a sweep ended.

    Attributes:
        code: exit code: 0; 2 for a user's mistake; 1 for a bug.
        message: one sentence for people; empty if all went well.
        detail: the traceback of a bug.
        overrides: what was asked for.
        multirun: the start of the sweep that last saw this job.
        command: the sweep's command, see `Record.command_hash`.
        fingerprint: of everything that the results depend on, see `fingerprint`.
        number: the job's place in the sweep.
        seconds: how long it took, s.
        before: an earlier start of the sweep did it.
    """

    code: int
    message: str
    detail: str
    overrides: tuple[str, ...]
    multirun: str = ""
    command: str = ""
    fingerprint: str = ""
    number: int = 0
    seconds: float = 0.0
    before: bool = False

    @classmethod
    def read(cls, folder: Path) -> JobStatus | None:
        """Returns how the job in `folder` ended; None if it left no marker that can be read."""
        return _read(cls, folder / STATUS, "overrides")

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the job's folder."""
        write_json(folder / STATUS, asdict(self))

    @property
    def state(self) -> str:
        """For people: done, done before or failed."""
        if self.code:
            return "failed"
        return "done before" if self.before else "done"


def metrics_of(folder: Path) -> dict[str, float]:
    """Returns the finite metrics of a finished job; empty if there are none."""
    from cfx.core.job_folder import read_metrics

    try:
        metrics = read_metrics(folder / "metrics.json")
    except DataError:
        return {}
    return {name: value for name, value in metrics.items() if math.isfinite(value)}


def data_of(folder: Path) -> dict[str, Any]:
    """Returns what `data.json` of a finished job says; empty if there is none."""
    from cfx.core.job_folder import read_json

    try:
        return read_json(folder / "data.json")
    except DataError:
        return {}


def judge_of_folder(folder: Path) -> MetricInfo:
    """Returns the error by which a finished job is judged."""
    from cfx.results.result import judge_of

    return judge_of(data_of(folder), metrics_of(folder))


@dataclass(frozen=True)
class Record:
    """What `sweep.json` says.

    Attributes:
        name: what the jobs share in MLflow; it stays when the sweep is continued from elsewhere.
        command: the overrides, as typed.
        command_hash: the same for the same overrides and values in any order.
        started: ISO 8601.
        jobs: how many there are, None if the sweeper decides as it goes.
        completed: ISO 8601; empty while jobs are missing or failed.
    """

    name: str
    command: tuple[str, ...]
    command_hash: str
    started: str
    jobs: int | None = None
    completed: str = ""

    @classmethod
    def read(cls, folder: Path) -> Record | None:
        """Returns the record in a sweep's folder; None if there is none that can be read."""
        return _read(cls, folder / RECORD, "command")

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the sweep's folder."""
        write_json(folder / RECORD, asdict(self))

    def statuses(self, folder: Path, multirun: str) -> dict[Path, JobStatus]:
        """Returns how the jobs ended that this start has seen or that were done before.

        They stand by their folders, in the sweep's order.
        """
        by_folder: dict[Path, JobStatus] = {}
        for marker in sorted(folder.rglob(STATUS)):
            job = marker.parent
            inside = job.relative_to(folder)
            between = (inside, *inside.parents)[:-1]
            if any((folder / place / RECORD).exists() for place in between):
                continue  # of another sweep below this one
            status = JobStatus.read(job)
            if status is None:
                continue
            if status.multirun == multirun:
                by_folder[job] = status
            elif status.code == 0 and status.command == self.command_hash:
                by_folder[job] = replace(status, before=True)
        return dict(sorted(by_folder.items(), key=lambda item: item[1].number))


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
        command_hash, resumable: as of `Record` and `Sweep`.

    Raises:
        ConfigError: another sweep uses the folder that was asked for.
        OSError: the folder cannot be made.
    """
    if not _DATED.search(configured):
        return _named_folder(wanted, resumable=resumable)
    if resumable:
        incomplete = _incomplete_folder(_pattern(configured), command_hash)
        if incomplete is not None:
            return incomplete
    while True:
        folder = new_folder(wanted)
        lock = _try_lock(folder)
        if lock is not None:
            return folder, lock


def _pattern(folder: str) -> str:
    """Returns the glob of a configured folder: what is interpolated may be anything."""
    replaced = 1
    while replaced:  # innermost interpolations first
        folder, replaced = re.subn(r"\$\{[^${}]*\}", "\0", folder)
    return "*".join(glob.escape(part) for part in folder.split("\0"))


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


def new_folder(wanted: Path) -> Path:
    """Makes a folder that did not exist before; returns it, numbered where its name was taken.

    Raises:
        OSError: it cannot be made, or a file has its name.
    """
    folder, number = wanted, 1
    while True:
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if not wanted.is_dir():
                raise
            number += 1
            folder = wanted.with_name(f"{wanted.name}-{number}")
        else:
            return folder


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


def fingerprint(values: Mapping[str, Any]) -> str:
    """Returns a hash of what a job's results depend on.

    It covers the configuration, the versions of cfx and of plugins, and the state of the data file.

    Raises:
        PluginError: a component that is named is not there.
    """
    from cfx.results import provenance

    plugins = provenance.distributions(values) | provenance.named_distributions(values)
    data = _state_of_data(values.get("data"))
    parts = {"config": values, "cfx": provenance.version(), "plugins": plugins, "data": data}
    return content_key(parts)


def job_name(_root_: Any) -> str:
    """Returns the end of a job folder's name: `${cfx_job:}` in Hydra's configuration.

    It is the same for the same overrides in any order.
    """
    task: Any = OmegaConf.to_container(_root_.hydra.overrides.task, resolve=False)
    by_key = {}
    for override in task:  # of a key given twice the last one counts
        key, _, _ = override.partition("=")
        by_key[key] = override
    return content_key([sorted(by_key.values()), *_sources(_root_)])[:8]


def command_of(config: DictConfig) -> tuple[tuple[str, ...], str, int | None]:
    """Returns the command of a sweep: as typed, as a hash, and how many jobs it makes.

    The hash knows no order. Of Hydra's own overrides only those of the sweeper count: the same
    sweep may go on with another launcher. The number of jobs is None if the sweeper decides as it
    goes.
    """
    typed: Any = OmegaConf.to_container(config.hydra.overrides, resolve=False)
    sweeper: Any = OmegaConf.to_container(config.hydra.sweeper, resolve=False)
    overrides = []  # those that the sweeper's own configuration adds come first
    for key, value in (sweeper.pop("params", None) or {}).items():
        overrides.append(f"{key}={value}")
    overrides += typed["task"]
    values: dict[str, list[str]] = {}
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    for override in parser.parse_overrides(overrides):
        key = override.get_key_element()
        if override.is_discrete_sweep():
            values[key] = sorted(override.sweep_string_iterator())
        else:
            values[key] = [str(override.input_line)]

    jobs = None
    if str(sweeper.get("_target_", "")).endswith(".BasicSweeper"):
        jobs = math.prod(len(set(options)) for options in values.values())
    command = (*typed["task"], *typed["hydra"])
    return command, content_key([values, sweeper, *_sources(config)]), jobs


def _state_of_data(node: Any) -> list[list[Any]] | None:
    """Returns size and time of change (ns) of each data file; None if the dataset names none.

    A folder stands for the parquet files in it. Of files behind a URL it is what their store says
    that they are.
    """
    if not isinstance(node, Mapping) or not node.get("path"):
        return None
    from cfx.data.files import partitions

    named = node["path"]
    patterns = named if isinstance(named, list | tuple) else [named]
    states: list[list[Any]] = []
    for pattern in patterns:
        if is_url(pattern):
            with contextlib.suppress(CfxError):
                states.append(state(pattern))
            continue
        path = Path(str(pattern)).expanduser()
        files = [str(path)] if path.exists() else sorted(glob.glob(str(path)))  # noqa: PTH207 - the pattern may be absolute, Path.glob takes none
        for file in files:
            # The dataset complains about a file that is gone, and about a folder without any.
            with contextlib.suppress(OSError, CfxError):
                for part in partitions(Path(file)):
                    status = part.stat()
                    states.append([status.st_size, status.st_mtime_ns])
    return states


def _sources(config: Any) -> tuple[Any, ...]:
    """Returns what else decides what the overrides mean: --config-name and --config-dir."""
    sources = config.hydra.runtime.config_sources
    folders = []
    for source in sources:
        if source.provider == "command-line":  # so Hydra calls --config-dir
            folders.append(str(source.path))
    return str(config.hydra.job.config_name), folders


OmegaConf.register_new_resolver("cfx_job", job_name, replace=True)
