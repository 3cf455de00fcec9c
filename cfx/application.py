"""The Hydra application: composes, runs one job or many, and turns whatever happens into an exit code and one clear message.

Hydra's own error handling prints tracebacks and exits with 1, so `HYDRA_FULL_ERROR` is set for the time of the call: exceptions
then reach this module. A job itself never raises into Hydra; it leaves an `ProtocolResult`, in a multirun as `outcome.json` in its
folder, which is how worker processes and other machines report too. So one failed job stops no other, and a multirun that was
broken off goes on where it stopped: see `cfx.sweep`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import time
import traceback
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx import hydra_source, nodes, registry, renamed
from cfx.errors import CfxError, ConfigError
from cfx.sweep import (
    STATUS,
    JobStatus,
    Record,
    Refused,
    SweepFolder,
    fingerprint,
    metrics_of,
    only_one,
    worker_of,
)
from cfx.user_errors import explain, is_user_error

if TYPE_CHECKING:
    from cfx.job import JobResult

log = logging.getLogger(__name__)

JOB = "cfx.job:run_job"
"""`run_job(config: JobConfig, folder: Path) -> JobResult`; imported when a job starts."""

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM."""


class JobFunction:
    """The function that Hydra calls for each job; it is pickled into worker processes."""

    def __init__(self, target: str, multirun: str, show_traceback: bool) -> None:
        self.target = target
        self.multirun = multirun
        self.process = os.getpid()
        self.show_traceback = show_traceback
        self.status: JobStatus | None = None

    def __call__(self, config: DictConfig) -> float:
        """Runs one job; one of a multirun that was done before is not run again.

        Returns:
            The policy's RMSE of speed, m/s, for sweepers that optimise; NaN if the job failed.
        """
        hydra_config = HydraConfig.get()
        folder = Path(hydra_config.runtime.output_dir)
        given: Any = OmegaConf.to_container(
            hydra_config.overrides.task, resolve=False
        )  # as typed, `${...}` included
        if hydra_config.mode == RunMode.MULTIRUN:
            record = Record.read(Path(str(hydra_config.sweep.dir)))
            blank = JobStatus(
                0,
                "",
                "",
                tuple(given),
                self.multirun,
                record.command_hash if record else "",
                number=int(hydra_config.job.num),
            )
            with worker_of(self.process), only_one(folder):
                metric, self.status = self._attempt(
                    config, folder, blank, record.name if record else str(folder.parent)
                )
                self.status.write(folder)
            where = f"{blank.number} ({' '.join(given)}) "
        else:
            metric, self.status = self._attempt(
                config, folder, JobStatus(0, "", "", tuple(given)), ""
            )
            where = ""
        if self.status.code:
            detail = f"\n{self.status.detail}" if self.status.detail else ""
            # A single job's message is printed by `start`, once.
            log.error(
                "job %sfailed: %s%s",
                where,
                self.status.message,
                detail,
                extra={"file_only": not where},
            )
        return metric

    def _attempt(
        self, config: DictConfig, folder: Path, blank: JobStatus, sweep: str
    ) -> tuple[float, JobStatus]:
        """Runs a job, or finds that it was done.

        Args:
            blank: what is known of its outcome.
            sweep: the multirun's name, "" for a single job.
        """
        began = time.monotonic()

        def failed(code: int, message: str, *, show: bool = True) -> tuple[float, JobStatus]:
            detail = traceback.format_exc().rstrip() if show else ""
            seconds = time.monotonic() - began
            return float("nan"), replace(
                blank, code=code, message=message, detail=detail, seconds=seconds
            )

        try:
            values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            if sweep:
                if values.get("tracking", {}).get("sweep", "") is None:
                    values["tracking"]["sweep"] = sweep
                blank = replace(blank, fingerprint=fingerprint(values))
                earlier = JobStatus.read(folder)
                if (
                    earlier is not None
                    and earlier.code == 0
                    and earlier.fingerprint == blank.fingerprint
                ):
                    log.info("job %d (%s) was done before", blank.number, " ".join(blank.overrides))
                    return _metric(metrics_of(folder)), replace(
                        blank, seconds=earlier.seconds, before=True
                    )
                (folder / STATUS).unlink(missing_ok=True)  # what it says is no longer so
            result = _call(self.target, values, folder)
        except (Exception, SystemExit) as error:
            signalled = _signal_behind(error)
            if signalled is not None:
                raise signalled from None
            if isinstance(error, CfxError | OmegaConfBaseException):
                return failed(2, explain(error, ()), show=self.show_traceback)
            if isinstance(error, SystemExit):
                return failed(1, f"the job called sys.exit({error.code!r})")
            return failed(
                1, f"{type(error).__name__}: {error}"
            )  # a bug: its traceback is printed, and the other jobs go on
        return _metric(result.metrics), replace(blank, seconds=time.monotonic() - began)


class Terminated(BaseException):
    """SIGTERM arrived."""


def start(arguments: Sequence[str], *, target: str = JOB) -> int:
    """Runs the Hydra application and returns its exit code; prints each message once."""
    arguments = todays(arguments)
    overrides = [one for one in arguments if not one.startswith("-")]
    show_traceback = wants_traceback(arguments)
    job = JobFunction(target, uuid.uuid4().hex, show_traceback)
    SweepFolder.take()
    try:
        with _process_state(arguments):
            hydra_source.register()
            hydra.main(config_path=str(nodes.conf_dir()), config_name="config", version_base="1.3")(
                job
            )()
        code = 0
    except SystemExit as error:
        # Hydra exits with 0 after --help and the like, with 1 or argparse's 2 after a message about a wrong flag.
        code = 0 if not error.code else 2
    except Refused as error:
        code = _report(error.__cause__, overrides, show_traceback)
    except (KeyboardInterrupt, Terminated) as error:
        code = _interrupted(error)
    except BrokenPipeError:
        raise  # the reader of stdout has gone; `cfx.cli.main` knows what that means
    except Exception as error:  # everything ends as an exit code
        signalled = _signal_behind(error)
        code = (
            _interrupted(signalled)
            if signalled is not None
            else _report(error, overrides, show_traceback)
        )
    sweep = SweepFolder.take()
    if sweep is not None:
        return sweep.close(job.multirun, code, interrupted=code in {INTERRUPTED, TERMINATED})
    if job.status is not None and job.status.code:
        print(job.status.detail or job.status.message, file=sys.stderr)
        return job.status.code
    return code


def run(overrides: Sequence[str] = (), *, target: str = JOB) -> JobResult:
    """Runs the job that `python -m cfx OVERRIDES` runs, in this process and into a fresh output folder.

    Args:
        overrides: as on the command line: `["model=w99", "data.max_pairs=10"]`.

    Raises:
        CfxError: whatever the command line would print and exit 2 for.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"give a list of overrides: cfx.run({overrides.split()!r})")
    overrides = todays(overrides)
    try:
        config = hydra_source.composed(overrides)
        values = hydra_source.plain(config)
        with hydra_source.resolving(config):
            folder = _fresh(Path(str(config.hydra.run.dir)).absolute())
    except Exception as error:
        if is_user_error(error) and not isinstance(error, CfxError):
            raise ConfigError(explain(error, overrides)) from None
        raise
    with _log_file(folder / "cfx.log"):
        return cast("JobResult", _call(target, values, folder))


def wants_traceback(arguments: Sequence[str]) -> bool:
    """Says whether the user asked for tracebacks even of their own mistakes."""
    asked = any(
        os.environ.get(name, "") not in {"", "0"} for name in ("CFX_TRACEBACK", "HYDRA_FULL_ERROR")
    )
    return asked or any(
        one.startswith("hydra.verbose=") and not one.lower().endswith("=false") for one in arguments
    )


def todays(arguments: Sequence[str]) -> list[str]:
    """Returns arguments under today's names; see `cfx.renamed`."""
    chosen = {}
    for argument in arguments:
        key, _, value = argument.partition("=")
        chosen[key.lstrip("+")] = value.split(",")

    def is_current(path: str) -> bool:
        names = chosen.get(path.partition(".")[0], [])
        return any(registry.has_setting(name, path) for name in names)

    return renamed.overrides(arguments, is_current)


def _call(target: str, values: Any, folder: Path) -> Any:
    from cfx.config import JobConfig

    job_config = JobConfig.of(values)
    module, _, function = target.partition(":")
    return getattr(import_module(module), function)(job_config, folder)


def _interrupted(signalled: BaseException) -> int:
    terminated = isinstance(signalled, Terminated)
    print(
        f"{'terminated' if terminated else 'interrupted'}; what was finished is kept",
        file=sys.stderr,
    )
    return TERMINATED if terminated else INTERRUPTED


def _signal_behind(error: BaseException) -> BaseException | None:
    """Returns the Ctrl-C or SIGTERM that an error comes from.

    Lightning answers Ctrl-C with sys.exit, and a library that a signal hits while it tidies up may raise an error of its own.
    """
    current: BaseException | None = error
    while current is not None:
        if isinstance(current, KeyboardInterrupt | Terminated):
            return current
        current = current.__context__
    return None


def _metric(metrics: Mapping[str, float]) -> float:
    return float(metrics.get("rmse_speed/policy", float("nan")))


def _report(error: BaseException | None, overrides: Sequence[str], show_traceback: bool) -> int:
    assert error is not None
    if type(error).__name__ in {
        "TerminatedWorkerError",
        "BrokenProcessPool",
    }:  # joblib's; importing it takes a while
        print(
            "a worker process was killed, perhaps because memory ran out: hydra.launcher.n_jobs=N makes fewer at a time",
            file=sys.stderr,
        )
        return 1
    mistake = is_user_error(error)
    if show_traceback or not mistake:
        traceback.print_exception(error)
    if mistake:
        print(explain(error, overrides), file=sys.stderr)
    return 2 if mistake else 1


def _fresh(folder: Path) -> Path:
    """Creates an output folder that did not exist before.

    Raises:
        ConfigError: it cannot be created.
    """
    candidate, number = folder, 1
    while True:
        try:
            candidate.mkdir(parents=True)
        except FileExistsError:
            if not folder.is_dir():
                raise ConfigError(
                    f"{folder} is a file; choose another output folder with hydra.run.dir=FOLDER"
                ) from None
            number += 1
            candidate = folder.with_name(f"{folder.name}-{number}")
        except OSError as error:
            raise ConfigError(explain(error, ())) from None
        else:
            return candidate


@contextlib.contextmanager
def _process_state(arguments: Sequence[str]) -> Iterator[None]:
    """Lends Hydra the process: arguments, environment, logging and SIGTERM are put back afterwards."""
    root = logging.getLogger()
    argv, handlers, level = sys.argv, list(root.handlers), root.level
    before = os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = ["cfx", *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with _sigterm():
            yield
    finally:
        sys.argv = argv
        if before is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = before
        for handler in [one for one in root.handlers if one not in handlers]:
            root.removeHandler(handler)
            handler.close()
        for handler in [one for one in handlers if one not in root.handlers]:
            root.addHandler(handler)
        root.setLevel(level)


@contextlib.contextmanager
def _sigterm() -> Iterator[None]:
    def terminate(_number: int, _frame: FrameType | None) -> None:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, terminate)
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _log_file(path: Path) -> Iterator[None]:
    logger = logging.getLogger("cfx")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(min(level or logging.INFO, logging.INFO))
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        handler.close()
