"""Sweeps that can be broken off and started again: their folder, the marker of each job, and the summary.

A sweep is a Hydra multirun. Its folder holds `sweep.json` (which command it belongs to), a folder per job, named by the job's
overrides so that the same job always finds its own, and `summary.csv`. The marker of a job is `outcome.json`, written whole and
last: a job whose marker says that it ended well with the same configuration, versions and data is not run again. A folder and a
job are used by one process at a time; the operating system frees their locks when it ends, however it ends.

Hydra knows a sweep's folder in two ways: the master configuration, and the overrides from which each job is composed again, also
in worker processes. `SweepFolder`, which Hydra calls when a multirun starts, sets both.
"""

from __future__ import annotations

import contextlib
import copy
import csv
import glob
import json
import logging
import math
import os
import re
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

from filelock import FileLock, Timeout
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from cfx.component import content_key
from cfx.console import blank_table, put
from cfx.errors import ConfigError
from cfx.files import atomic_write
from cfx.hydra_source import resolving

if TYPE_CHECKING:
    from rich.table import Table

log = logging.getLogger(__name__)

STATUS, RECORD, SUMMARY = "outcome.json", "sweep.json", "summary.csv"
"""A job's marker in its folder; what the sweep is, and what came of it, in the sweep's."""

_LOCK = ".lock"
_AGAIN = "The same command again runs only the jobs that are not done."
_AT_WORK = threading.Lock()
_WATCHED: set[int] = set()
_WATCH_S = 1.0
_DATED = re.compile(r"\$\{\s*now\s*:")
_BASELINES = ("population", "fixed")
"""What a policy is compared with, the first that was measured: one set for all training drivers if drivers are unseen."""


@dataclass(frozen=True)
class JobStatus:
    """How a job of a sweep ended.

    Attributes:
        code: exit code: 0; 2 for a user's mistake; 1 for a bug.
        message: one sentence for people, empty if all went well.
        detail: the traceback of a bug.
        overrides: what was asked for.
        multirun: the start of the sweep that last saw this job.
        command: the sweep's command, see `Record.command_hash`.
        fingerprint: of everything that the results depend on, see `fingerprint`.
        number: the job's place in the sweep.
        seconds: how long it took.
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
    def read(cls, folder: Path) -> Self | None:
        """Returns the outcome of the job in `folder`; None if it left none that can be read."""
        try:
            values = json.loads((folder / STATUS).read_text(encoding="utf-8"))
            return cls(**{**values, "overrides": tuple(values["overrides"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the job's folder."""
        _write_json(folder / STATUS, asdict(self))

    @property
    def state(self) -> str:
        """For people: done, done before or failed."""
        return "failed" if self.code else "done before" if self.before else "done"


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
    def read(cls, folder: Path) -> Self | None:
        """Returns the record in a sweep's folder; None if there is none that can be read."""
        try:
            values = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            return cls(**{**values, "command": tuple(values["command"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def write(self, folder: Path) -> None:
        """Writes it, whole, into the sweep's folder."""
        _write_json(folder / RECORD, asdict(self))

    def statuses(self, folder: Path, multirun: str) -> dict[Path, JobStatus]:
        """Returns, by folder and in the sweep's order, the jobs that this start has seen and those that were done before."""
        found = {
            path.parent: JobStatus.read(path.parent)
            for path in sorted(folder.rglob(STATUS))
            if _is_in(path.parent, folder)
        }
        ours = {
            path: status if status.multirun == multirun else replace(status, before=True)
            for path, status in found.items()
            if status is not None
            and (
                status.multirun == multirun
                or (status.code == 0 and status.command == self.command_hash)
            )
        }
        return dict(sorted(ours.items(), key=lambda item: item[1].number))


class Refused(BaseException):
    """A sweep cannot start; the cause says why. Hydra swallows a callback's `Exception`, so this is none."""


class Sweep:
    """A sweep that runs in this process.

    Attributes:
        folder: of the sweep, as people see it.
        record: what `sweep.json` says.
        tracking: the resolved configuration of tracking.
        resumable: the folders of its jobs are named by what the jobs are.
    """

    def __init__(
        self,
        folder: Path,
        lock: FileLock,
        record: Record,
        tracking: Mapping[str, Any],
        *,
        resumable: bool,
    ) -> None:
        self.folder = folder
        self.record = record
        self.tracking = tracking
        self.resumable = resumable
        self._lock = lock

    @classmethod
    def open(cls, config: DictConfig) -> Self:
        """Finds or makes the folder of the multirun that `config` describes, and holds its lock until `close`.

        Raises:
            ConfigError: another sweep runs in the folder that was asked for.
            OSError: the folder cannot be made.
        """
        command, digest, jobs = _command(config)
        raw: Any = OmegaConf.to_container(config.hydra.sweep, resolve=False)
        wanted = Path(str(config.hydra.sweep.dir))
        resumable = "cfx_job" in str(raw["subdir"])
        if _DATED.search(str(raw["dir"])):
            found = _left_over(_pattern(str(raw["dir"])), digest) if resumable else None
            folder, lock = found or _fresh(wanted)
        else:
            folder, lock = _asked_for(wanted, resumable=resumable)
        now = _now()
        earlier = Record.read(folder)
        record = Record(str(folder), command, digest, now, jobs)
        if earlier is not None:
            same = earlier.command_hash == digest
            record = replace(record, name=earlier.name, started=earlier.started if same else now)
            print(_continuing(folder, record, earlier), flush=True)
        record.write(folder)
        return cls(folder, lock, record, _tracking(config), resumable=resumable)

    def lead(self, config: DictConfig) -> None:
        """Sends Hydra into the folder: `config` itself, and the overrides that each job is composed from."""
        path = str(self.folder)
        given: Any = OmegaConf.to_container(config.hydra.overrides.hydra, resolve=False)
        overrides = [one for one in given if not one.startswith("hydra.sweep.dir=")]
        with open_dict(config.hydra):
            config.hydra.sweep.dir = path
            config.hydra.overrides.hydra = [
                *overrides,
                "hydra.sweep.dir='" + path.replace("'", "\\'") + "'",
            ]

    def close(self, multirun: str, code: int, *, interrupted: bool) -> int:
        """Says how the sweep ended, on the terminal and in `summary.csv`, and lets go of its folder.

        Args:
            multirun: this start of the sweep.
            code: exit code so far.
            interrupted: a signal ended it.

        Returns:
            The exit code.
        """
        try:
            statuses = self.record.statuses(self.folder, multirun)
            lines = self._tracked() if statuses or interrupted else ()
            if not statuses:
                return self._nothing(code, interrupted=interrupted)
            table = rows(statuses)
            write_summary(self.folder / SUMMARY, table)
            put(summary_table(table))
            code = self._tell(statuses, code)
            if any(status.code == 0 for status in statuses.values()):
                for line in (
                    *lines,
                    f"Report of the whole sweep: python -m cfx report {shlex.quote(str(self.folder))}",
                ):
                    print(line)
            if code == 0:
                replace(self.record, completed=_now()).write(self.folder)
            elif self.resumable:
                print(_AGAIN)
            return code
        finally:
            self._lock.release()

    def _tell(self, statuses: Mapping[Path, JobStatus], code: int) -> int:
        """Prints how many jobs are done, and which failed and why; returns the exit code."""
        failed = {path: status for path, status in statuses.items() if status.code}
        total = max(self.record.jobs or 0, len(statuses))
        print(f"{len(statuses) - len(failed)} of {total} jobs done; their folders: {self.folder}")
        for path, status in failed.items():
            print(
                f"failed: {' '.join(status.overrides)}: {status.message} ({path})", file=sys.stderr
            )
        if total > len(statuses) and not code:
            print(
                f"{total - len(statuses)} jobs left no outcome; see the launcher's own logs",
                file=sys.stderr,
            )
            code = 1
        return worst(code, *(status.code for status in failed.values()))

    def _nothing(self, code: int, *, interrupted: bool) -> int:
        if not code:
            print(
                f"no job left its outcome in {self.folder}; see the launcher's own logs",
                file=sys.stderr,
            )
            return 1
        if not interrupted and not any(path.is_dir() for path in self.folder.iterdir()):
            # A wrong command line that no job was made of leaves no folder.
            for name in (RECORD, "multirun.yaml", _LOCK):
                (self.folder / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.folder.rmdir()
        elif self.resumable:
            print(_AGAIN)
        return code

    def _tracked(self) -> tuple[str, ...]:
        """Closes runs that killed jobs left open; returns lines that tell where the sweep is in MLflow."""
        from cfx.errors import TrackingError
        from cfx.tracking.store import sqlite_file, tracking_uri

        if not self.tracking.get("enabled"):
            return ()
        try:
            uri = tracking_uri(self.tracking.get("uri"))
            file = sqlite_file(uri)
            if file is not None and not file.is_file():
                return ()
            from cfx.tracking.tracker import end_sweep

            return end_sweep(
                uri,
                str(self.tracking.get("experiment")),
                self.tracking.get("sweep") or self.record.name,
            )
        except TrackingError as error:
            log.warning("%s", error)
            return ()


class SweepFolder(Callback):
    """Chooses the folder when Hydra starts a multirun; `conf/config.yaml` names it as a callback."""

    _current: ClassVar[Sweep | None] = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            SweepFolder._current = Sweep.open(config)
            SweepFolder._current.lead(config)
        except Exception as error:
            raise Refused from error

    @classmethod
    def take(cls) -> Sweep | None:
        """Returns the sweep that was started, if one was, and forgets it."""
        sweep, cls._current = cls._current, None
        return sweep


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Holds a job's folder: the worker of a killed sweep may still be at that job, and is waited for."""
    lock = FileLock(folder / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        log.info("%s: another process runs this job; waiting for it.", folder)
        lock.acquire(poll_interval=0.2)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def worker_of(process: int) -> Iterator[None]:
    """Runs a job; a worker whose sweep is killed ends when the job does: joblib's would wait for ever for the next.

    Args:
        process: the one that runs the sweep.
    """
    if os.getpid() != process == os.getppid() and process not in _WATCHED:
        _WATCHED.add(process)
        threading.Thread(target=_end_with, args=(process,), daemon=True).start()
    elif process in _WATCHED and os.getppid() != process:
        os._exit(1)  # a job that was handed over already is the next start's
    with _AT_WORK:
        yield


def _end_with(process: int) -> None:
    while os.getppid() == process:
        time.sleep(_WATCH_S)
    with _AT_WORK:
        os._exit(1)


def fingerprint(values: Mapping[str, Any]) -> str:
    """Returns a hash of what a job's results depend on: configuration, versions of cfx and of plugins, state of the data file.

    Args:
        values: the job's resolved configuration.

    Raises:
        PluginError: a component that is named is not there.
    """
    from cfx.tracking import provenance

    node = values.get("data")
    path = node.get("path") if isinstance(node, Mapping) else None
    state = None
    if path:
        with contextlib.suppress(
            OSError
        ):  # a file that is not there is the dataset's to complain about
            found = Path(str(path)).expanduser().stat()
            state = [found.st_size, found.st_mtime_ns]
    parts = {
        "config": values,
        "cfx": provenance.version(),
        "plugins": provenance.distributions(values),
        "data": state,
    }
    return content_key(parts)


def job_name(_root_: Any) -> str:
    """Returns the end of a job folder's name, the same for the same overrides in any order: `${cfx_job:}` in Hydra's config."""
    task: Any = OmegaConf.to_container(_root_.hydra.overrides.task, resolve=False)
    given = {
        one.partition("=")[0]: one for one in task
    }  # where a key is given twice the last one counts
    return content_key([sorted(given.values()), *_sources(_root_)])[:8]


OmegaConf.register_new_resolver("cfx_job", job_name, replace=True)


def metrics_of(folder: Path) -> dict[str, float]:
    """Returns the finite metrics of a finished job, by their MLflow names; empty if there are none."""
    try:
        values = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(values, dict):
        return {}
    return {
        name: float(value)
        for name, value in values.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }


def rows(statuses: Mapping[Path, JobStatus]) -> list[dict[str, Any]]:
    """Returns a row per job of the summary: folder, the overrides that differ, improvement, RMSE of speed, seconds and state."""
    given = [
        dict(one.partition("=")[::2] for one in status.overrides) for status in statuses.values()
    ]
    keys = list(dict.fromkeys(key for one in given for key in one))
    differing = [key for key in keys if len({one.get(key) for one in given}) > 1] or keys
    table = []
    for (folder, status), own in zip(statuses.items(), given, strict=True):
        found = {} if status.code else metrics_of(folder)
        baseline = next((one for one in _BASELINES if f"rmse_improvement/{one}/mean" in found), "")
        prefix = f"rmse_improvement/{baseline}" if baseline else "rmse_improvement"
        improvement = {
            f"improvement_{name}": found.get(f"{prefix}/{name}")
            for name in ("mean", "ci95_low", "ci95_high")
        }
        rmse = {
            f"rmse_speed_{name}": found.get(f"rmse_speed/{name}")
            for name in ("default", "fixed", "population", "policy")
        }
        table.append(
            {
                "folder": folder.name,
                **{key: own.get(key, "") for key in differing},
                "improvement_over": (baseline or "fixed")
                if improvement["improvement_mean"] is not None
                else "",
                **improvement,
                **rmse,
                "seconds": round(status.seconds, 1),
                "state": status.state,
                "message": status.message,
            }
        )
    return table


def write_summary(path: Path, table: Sequence[Mapping[str, Any]]) -> None:
    """Writes `rows` as CSV; a cell without a value is empty."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def summary_table(table: Sequence[Mapping[str, Any]]) -> Table:
    """Returns `rows` as a rich table."""
    over = {row["improvement_over"] for row in table} - {""}
    several = len(over) > 1
    columns = [key for key in table[0] if key not in _FIXED_COLUMNS]
    shown = blank_table(*(columns or ["job"]), title="The sweep")
    heading = f"improvement over {min(over)}" if len(over) == 1 else "improvement"
    shown.add_column(f"{heading}\n(95 % interval)", justify="right")
    for name in ("default", "fixed", "policy"):
        shown.add_column(f"RMSE speed [m/s]\n{name}", justify="right")
    shown.add_column("time [s]", justify="right")
    shown.add_column("state")
    for row in table:
        shown.add_row(
            *([str(row[column]) for column in columns] or [row["folder"]]),
            _improvement(row)
            + (f" over {row['improvement_over']}" if several and row["improvement_over"] else ""),
            *(_number(row[f"rmse_speed_{name}"]) for name in ("default", "fixed", "policy")),
            f"{row['seconds']:.1f}",
            row["state"],
        )
    return shown


def worst(*codes: int) -> int:
    """Returns the exit code that weighs most: a signal, then a bug, then a user's mistake."""
    return max(codes, key=lambda code: {0: 0, 2: 1, 1: 2}.get(code, 3))


_FIXED_COLUMNS = frozenset(
    ["folder", "improvement_over", "seconds", "state", "message"]
    + [f"improvement_{name}" for name in ("mean", "ci95_low", "ci95_high")]
    + [f"rmse_speed_{name}" for name in ("default", "fixed", "population", "policy")]
)


def _improvement(row: Mapping[str, Any]) -> str:
    if row["improvement_mean"] is None:
        return ""
    ends = [row["improvement_ci95_low"], row["improvement_ci95_high"]]
    interval = "" if None in ends else f" ({ends[0]:+.1%} to {ends[1]:+.1%})"
    return f"{row['improvement_mean']:+.1%}{interval}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _command(config: DictConfig) -> tuple[tuple[str, ...], str, int | None]:
    """Returns what was asked for: as typed, as a hash that knows no order, and how many jobs that makes.

    Of Hydra's own overrides only those of the sweeper count: the same sweep may go on with another launcher.
    """
    typed: Any = OmegaConf.to_container(config.hydra.overrides, resolve=False)
    sweeper: Any = OmegaConf.to_container(config.hydra.sweeper, resolve=False)
    asked = [
        f"{key}={value}" for key, value in (sweeper.pop("params", None) or {}).items()
    ] + typed["task"]
    values: dict[str, list[str]] = {}
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    for override in parser.parse_overrides(asked):
        key = override.get_key_element()
        if override.is_discrete_sweep():
            values[key] = sorted(override.sweep_string_iterator())
        else:
            values[key] = [str(override.input_line)]
    basic = str(sweeper.get("_target_", "")).endswith(".BasicSweeper")
    jobs = math.prod(len(set(one)) for one in values.values()) if basic else None
    return (
        (*typed["task"], *typed["hydra"]),
        content_key([values, sweeper, *_sources(config)]),
        jobs,
    )


def _tracking(config: DictConfig) -> dict[str, Any]:
    """Returns the resolved configuration of tracking; nothing where only a job's own configuration can say it."""
    try:
        with resolving(copy.deepcopy(config)):  # it makes what it is given read-only
            return cast("dict[str, Any]", OmegaConf.to_container(config.tracking, resolve=True))
    except (OmegaConfBaseException, ValueError):
        return {}


def _sources(config: Any) -> tuple[Any, ...]:
    """Returns what else on the command line decides what the overrides mean: --config-name and --config-dir."""
    given = [
        str(source.path)
        for source in config.hydra.runtime.config_sources
        if source.provider == "command-line"
    ]
    return str(config.hydra.job.config_name), given


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
    lock = FileLock(folder / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    return lock


def _continuing(folder: Path, record: Record, earlier: Record) -> str:
    done = sum(one.code == 0 for one in record.statuses(folder, "").values())
    if earlier.command_hash == record.command_hash:
        return f"continuing sweep {folder}: {done}{f' of {record.jobs}' if record.jobs else ''} jobs are done"
    return f"continuing in {folder}, which holds another command's sweep: jobs that both have in common are not run again"


def _is_in(job: Path, sweep: Path) -> bool:
    """Says whether a folder below a sweep's belongs to it, and not to another sweep below."""
    between = job.relative_to(sweep).parents
    return not any(
        (sweep / one / RECORD).exists() for one in [job.relative_to(sweep), *between][:-1]
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
