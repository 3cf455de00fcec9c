"""Sweeps: Hydra multiruns that can be broken off and started again.

A sweep's folder holds `sweep.json` (which command it belongs to), a folder per job, named by the
job's overrides so that the same job always finds its own, and `summary.csv`. The marker of a job is
`outcome.json`, written whole and last: a job whose marker says that it ended well with the same
configuration, versions and data is not run again.

Hydra knows a sweep's folder in two ways: the master configuration, and the overrides from which
each job is composed again, also in worker processes. `SweepFolder`, which Hydra calls, sets both.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import os
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Self

from filelock import BaseFileLock
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from cfx.app.hydra_source import resolving
from cfx.app.sweep.folder import LOCK, RECORD, JobStatus, Record, command_of, find_folder
from cfx.core.console import print_table

log = logging.getLogger(__name__)

_AGAIN = "The same command again runs only the jobs that are not done."


@dataclass(frozen=True)
class Sweep:
    """A sweep that runs in this process.

    Attributes:
        folder: of the sweep, as people see it.
        lock: of the folder, held until `close`.
        record: what `sweep.json` says.
        tracking: its resolved settings; empty where only a job's own configuration can say them.
        resumable: the folders of its jobs are named by what the jobs are.
    """

    folder: Path
    lock: BaseFileLock
    record: Record
    tracking: Mapping[str, Any]
    resumable: bool

    @classmethod
    def open(cls, config: DictConfig) -> Self:
        """Finds or makes the folder of a multirun, and sends Hydra there.

        The master configuration is changed in place, as are the overrides in it that each job is
        composed from.

        Raises:
            ConfigError: another sweep runs in the folder that was asked for.
            OSError: the folder cannot be made.
        """
        command, digest, jobs = command_of(config)
        raw: Any = OmegaConf.to_container(config.hydra.sweep, resolve=False)
        wanted = Path(str(config.hydra.sweep.dir))
        resumable = "cfx_job" in str(raw["subdir"])
        folder, lock = find_folder(str(raw["dir"]), wanted, digest, resumable=resumable)
        earlier = Record.read(folder)
        record = Record(str(folder), command, digest, _now(), jobs)
        if earlier is not None:
            record = replace(record, name=earlier.name)
            if earlier.command_hash == digest:
                record = replace(record, started=earlier.started)
            print(_continuing(folder, record, earlier), flush=True)
        record.write(folder)
        tracking: Any = {}
        copied = copy.deepcopy(config)  # what is resolved becomes read-only
        with contextlib.suppress(OmegaConfBaseException, ValueError), resolving(copied):
            tracking = OmegaConf.to_container(config.tracking, resolve=True)
        of_hydra: Any = OmegaConf.to_container(config.hydra.overrides.hydra, resolve=False)
        overrides = []
        for override in of_hydra:
            if not override.startswith("hydra.sweep.dir="):
                overrides.append(override)
        escaped = str(folder).replace("'", "\\'")
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra.sweep.dir = str(folder)
            config.hydra.overrides.hydra = [*overrides, f"hydra.sweep.dir='{escaped}'"]
        return cls(folder, lock, record, tracking, resumable)

    def close(self, multirun: str, code: int, *, interrupted: bool) -> int:
        """Says how the sweep ended, on the terminal and in `summary.csv`, and frees its folder.

        It takes this start of the sweep and the exit code so far, and returns the exit code.
        """
        try:
            statuses = self.record.statuses(self.folder, multirun)
            if statuses:
                return self._finish(statuses, code)
            if interrupted:
                self._close_runs()
            return self._finish_without_jobs(code, interrupted=interrupted)
        finally:
            self.lock.release()

    def _finish(self, statuses: Mapping[Path, JobStatus], code: int) -> int:
        """Writes and prints the summary, and says how to go on; returns the exit code."""
        from cfx.app.sweep.summary import SUMMARY, SweepSummary  # imports NumPy

        lines = self._close_runs()
        summary = SweepSummary.of(statuses)
        summary.write(self.folder / SUMMARY)
        print_table(summary.table())
        for sentence in summary.sentences():
            print(sentence)
        code = self._count(statuses, code)
        if _well_ended(statuses):
            for line in lines:
                print(line)
            folder = shlex.quote(str(self.folder))
            print(f"Report of the whole sweep: python -m cfx report {folder}")
        if code == 0:
            replace(self.record, completed=_now()).write(self.folder)
        elif self.resumable:
            print(_AGAIN)
        return code

    def _count(self, statuses: Mapping[Path, JobStatus], code: int) -> int:
        """Prints how many jobs are done, and which failed and why; returns the worst exit code."""
        done = _well_ended(statuses)
        total = max(self.record.jobs or 0, len(statuses))
        print(f"{done} of {total} jobs done; their folders: {self.folder}")
        codes = {code}
        for path, status in statuses.items():
            codes.add(status.code)
            if status.code:
                overrides = " ".join(status.overrides)
                print(f"failed: {overrides}: {status.message} ({path})", file=sys.stderr)
        missing = total - len(statuses)
        if missing and code == 0:
            print(f"{missing} jobs left no outcome; see the launcher's own logs", file=sys.stderr)
            codes.add(1)
        return max(codes, key=_severity)

    def _finish_without_jobs(self, code: int, *, interrupted: bool) -> int:
        """Says that no job ended, or removes a wrong command's folder; returns the exit code."""
        if code == 0:
            text = f"no job left its outcome in {self.folder}; see the launcher's own logs"
            print(text, file=sys.stderr)
            return 1
        has_jobs = any(path.is_dir() for path in self.folder.iterdir())
        if interrupted or has_jobs:
            if self.resumable:
                print(_AGAIN)
            return code
        for name in (RECORD, "multirun.yaml", LOCK):
            (self.folder / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()
        return code

    def _close_runs(self) -> tuple[str, ...]:
        """Closes runs that killed jobs left open; returns lines that lead to them."""
        from cfx.core.registry import names
        from cfx.errors import TrackingError
        from cfx.results.tracker import tracking_named

        name = str(self.tracking.get("name"))
        if not self.tracking.get("enabled") or name not in names("tracker"):
            return ()
        sweep = self.tracking.get("sweep") or self.record.name
        try:
            return tracking_named(name).end_sweep(self.tracking, sweep)
        except TrackingError as error:
            log.warning("%s", error)
            return ()


def _severity(code: int) -> int:
    """Returns how bad an exit code is: a signal is worst, then a bug, then a user's mistake."""
    return {0: 0, 2: 1, 1: 2}.get(code, 3)


def _well_ended(statuses: Mapping[Path, JobStatus]) -> int:
    """Returns how many jobs ended without an error."""
    return sum(status.code == 0 for status in statuses.values())


def _continuing(folder: Path, record: Record, earlier: Record) -> str:
    """Returns what is printed of a sweep in whose folder another one, or an earlier start, was."""
    if earlier.command_hash != record.command_hash:
        return (
            f"continuing in {folder}, which holds another command's sweep:"
            " jobs that both have in common are not run again"
        )
    done = _well_ended(record.statuses(folder, ""))
    total = f" of {record.jobs}" if record.jobs else ""
    return f"continuing sweep {folder}: {done}{total} jobs are done"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


class Refused(BaseException):
    """A sweep cannot start; the cause says why.

    It is no `Exception`, because Hydra swallows those in a callback.
    """


class SweepFolder(Callback):
    """Chooses the folder when Hydra starts a multirun; `conf/config.yaml` names this class."""

    _current: ClassVar[Sweep | None] = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            SweepFolder._current = Sweep.open(config)
        except Exception as error:
            raise Refused from error

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Lets go of a job's configurations, which Hydra would keep until the sweep ends.

        They take half a megabyte for each job; what a sweeper asks for is the returned value.
        """
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            job_return.cfg = None
            job_return.hydra_cfg = None

    @classmethod
    def take(cls) -> Sweep | None:
        """Returns the sweep that was started, if one was, and forgets it."""
        sweep = cls._current
        cls._current = None
        return sweep


_AT_WORK = threading.Lock()
"""Held while this process runs a job."""

_WATCHED: set[int] = set()
"""Processes of sweeps whose end this worker watches for."""


@contextlib.contextmanager
def worker_of(process: int) -> Iterator[None]:
    """Runs a job; a worker whose sweep was killed ends when its job does.

    joblib's workers would wait for the next job of that process for ever.
    """
    is_its_worker = os.getpid() != process and os.getppid() == process
    if is_its_worker and process not in _WATCHED:
        _WATCHED.add(process)
        threading.Thread(target=_end_with, args=(process,), daemon=True).start()
    elif process in _WATCHED and os.getppid() != process:
        os._exit(1)  # the next start of the sweep runs a job that was handed over already
    with _AT_WORK:
        yield


def _end_with(process: int) -> None:
    while os.getppid() == process:
        time.sleep(1.0)
    with _AT_WORK:
        os._exit(1)
