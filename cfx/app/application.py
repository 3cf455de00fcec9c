"""The Hydra application: composes, runs one job or many, and ends in an exit code and one message.

Hydra's own error handling prints tracebacks and exits with 1. `HYDRA_FULL_ERROR` is therefore set
for the time of the call, so that exceptions reach this module. A job itself never raises into
Hydra; it leaves a `JobStatus`, in a multirun as `outcome.json` in its folder, which is how worker
processes and other machines report too. So one failed job stops no other, and a multirun that was
broken off goes on where it stopped: see `cfx.app.sweep`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import sys
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx.app import hydra_source, nodes
from cfx.app.sweep import (
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
from cfx.app.user_errors import explain, is_user_error
from cfx.core import registry
from cfx.core.errors import (
    CfxError,
    ConfigError,
    JobFailedError,
    Terminated,
    printable,
    without_passwords,
)
from cfx.core.guest import guest, visit
from cfx.core.memory import is_out_of_memory
from cfx.core.plugin_errors import blame
from cfx.core.processes import raise_if_terminated, signal_behind, terminable
from cfx.core.storage import is_url

if TYPE_CHECKING:
    from cfx.app.job import JobResult
    from cfx.results.config import JobConfig

log = logging.getLogger(__name__)

RunJob = Callable[["JobConfig", Path], "JobResult"]
"""What runs a job; `cfx.app.job.run.run_job` unless a caller gives another."""

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM."""


class JobFunction:
    """The function that Hydra calls for each job; it is pickled into worker processes.

    Attributes:
        run_job: runs a job; None: cfx's own.
        multirun: this start of a multirun.
        process: the process that started it.
        show_traceback: users' mistakes too are shown with their traceback.
        status: how the job ended that ran last.
    """

    def __init__(self, run_job: RunJob | None, multirun: str, show_traceback: bool) -> None:
        self.run_job = run_job
        self.multirun = multirun
        self.process = os.getpid()
        self.show_traceback = show_traceback
        self.status: JobStatus | None = None

    def __call__(self, config: DictConfig) -> float:
        """Runs one job; one of a multirun that was done before is not run again.

        Returns:
            The policy's RMSE of speed, m/s, for sweepers that optimise; NaN if the job failed.

        Raises:
            JobFailedError: it failed, and the sweeper optimises: it counts failures.
        """
        raise_if_terminated()
        hydra_config = HydraConfig.get()
        folder = Path(hydra_config.runtime.output_dir)
        # As typed, `${...}` included.
        task: Any = OmegaConf.to_container(hydra_config.overrides.task, resolve=False)
        blank = JobStatus(0, "", "", tuple(task))
        if hydra_config.mode == RunMode.MULTIRUN:
            return self._run_in_sweep(config, folder, blank)
        metric, self.status = self._attempt(config, folder, blank, "")
        if self.status.code:
            # `start` prints the message of a single job, once.
            text = "job failed: %s%s"
            detail = _below(self.status.detail)
            log.error(text, self.status.message, detail, extra={"file_only": True})
        return metric

    def _run_in_sweep(self, config: DictConfig, folder: Path, blank: JobStatus) -> float:
        """Runs a job of a multirun, and leaves its status in its folder."""
        hydra_config = HydraConfig.get()
        record = Record.read(Path(str(hydra_config.sweep.dir)))
        sweep = str(folder.parent)
        blank = replace(blank, multirun=self.multirun, number=int(hydra_config.job.num))
        if record is not None:
            sweep = record.name
            blank = replace(blank, command=record.command_hash)
        with worker_of(self.process), only_one(folder):
            metric, self.status = self._attempt(config, folder, blank, sweep)
            self.status.write(folder)
        if self.status.code:
            text = "job %d (%s) failed: %s%s"
            overrides = " ".join(blank.overrides)
            detail = _below(self.status.detail)
            log.error(text, blank.number, overrides, self.status.message, detail)
            return _value_of_failed(config, hydra_config.sweeper, self.status)
        return metric

    def _attempt(
        self, config: DictConfig, folder: Path, blank: JobStatus, sweep: str
    ) -> tuple[float, JobStatus]:
        """Runs a job, or finds that it was done.

        Args:
            blank: what is known of its status.
            sweep: the multirun's name, "" for a single job.
        """
        began = time.monotonic()
        values: Any = {}
        try:
            values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            if sweep:
                if values.get("tracking", {}).get("sweep", "") is None:
                    values["tracking"]["sweep"] = sweep
                blank = replace(blank, fingerprint=fingerprint(values))
                earlier = JobStatus.read(folder)
                if _is_done(earlier, blank):
                    log.info("job %d (%s) was done before", blank.number, " ".join(blank.overrides))
                    status = replace(blank, seconds=earlier.seconds, before=True)
                    return _metric(metrics_of(folder)), status
                (folder / STATUS).unlink(missing_ok=True)  # what it says is no longer so
            with _blaming():
                result = (self.run_job or _own_job())(_job_config(values), folder)
        except (Exception, SystemExit) as error:
            status = self._failed(error, blank)
            if status.code == CfxError.exit_code:
                status = replace(status, message=status.message + _preset_behind(status, values))
            return float("nan"), replace(status, seconds=time.monotonic() - began)
        return _metric(result.metrics), replace(blank, seconds=time.monotonic() - began)

    def _failed(self, error: BaseException, blank: JobStatus) -> JobStatus:
        """Returns the status of a job that ended in an error; raises a signal that caused it."""
        signalled = signal_behind(error)
        if signalled is not None:
            raise signalled from None
        detail = traceback.format_exc().rstrip()
        if isinstance(error, CfxError | OmegaConfBaseException):
            if not self.show_traceback:
                detail = ""
            return replace(blank, code=2, message=explain(error, ()), detail=detail)
        # A bug: its traceback is printed, and the other jobs go on.
        message = f"{type(error).__name__}: {error}"
        if isinstance(error, SystemExit):
            message = f"the job called sys.exit({error.code!r})"
        return replace(blank, code=1, message=message, detail=detail)


def start(arguments: Sequence[str], *, run_job: RunJob | None = None) -> int:
    """Runs the Hydra application and returns its exit code; prints each message once."""
    _refuse_passwords(arguments)
    _refuse_interpolated_folder()
    _refuse_urls_as_folders(arguments)
    job = JobFunction(run_job, uuid.uuid4().hex, wants_traceback(arguments))
    SweepFolder.take()
    code = _run_hydra(job, arguments)
    sweep = SweepFolder.take()
    if sweep is not None:
        return sweep.close(job.multirun, code, interrupted=code in {INTERRUPTED, TERMINATED})
    if job.status is not None and job.status.code:
        print(job.status.detail or job.status.message, file=sys.stderr)
        return job.status.code
    return code


def _refuse_passwords(arguments: Sequence[str]) -> None:
    """Refuses a password in `tracking.uri`, before Hydra writes it into the job's folder.

    Raises:
        ConfigError: there is one.
    """
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key.lstrip("+") == "tracking.uri" and without_passwords(value) != value:
            from cfx.results.config import SAYS_TOO_MUCH

            raise ConfigError(f"tracking.uri={without_passwords(value)} {SAYS_TOO_MUCH}")


def _refuse_interpolated_folder() -> None:
    """Refuses a working directory whose name Hydra would take for an interpolation.

    Raises:
        ConfigError: it is such a one.
    """
    folder = str(Path.cwd())
    if "${" in folder:
        raise ConfigError(
            f"the working directory {folder} holds '${{', which Hydra replaces in paths; start from"
            " another folder"
        )


def _refuse_urls_as_folders(arguments: Sequence[str]) -> None:
    """Refuses a URL where Hydra would make a folder of that name.

    Raises:
        ConfigError: there is one.
    """
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key in {"hydra.run.dir", "hydra.sweep.dir"} and is_url(value.strip("'\"")):
            raise ConfigError(
                f"{key} is a folder of this machine; output.url={without_passwords(value)} copies"
                " jobs there when they are done"
            )


def _run_hydra(job: JobFunction, arguments: Sequence[str]) -> int:
    """Lets Hydra compose and call `job`; every way in which that ends becomes an exit code."""
    overrides = [one for one in arguments if not one.startswith("-")]
    try:
        _call_hydra(job, arguments)
    except SystemExit as error:
        # Hydra exits with 0 after --help and the like, with 1 or argparse's 2 after a message about
        # a wrong flag.
        return 2 if error.code else 0
    except Refused as error:
        return _report(error.__cause__, overrides, job.show_traceback)
    except (KeyboardInterrupt, Terminated) as error:
        return _interrupted(error)
    except BrokenPipeError:
        raise  # the reader of stdout has gone; `cfx.app.cli.main` knows what that means
    except Exception as error:
        signalled = signal_behind(error)
        if signalled is not None:
            return _interrupted(signalled)
        return _report(error, overrides, job.show_traceback)
    return 0


def _call_hydra(job: JobFunction, arguments: Sequence[str]) -> None:
    """Lets Hydra compose and call `job`."""
    application = hydra.main(
        config_path=str(nodes.conf_dir()), config_name="config", version_base="1.3"
    )
    with guest(), terminable():
        sys.argv = ["cfx", *arguments]
        os.environ["HYDRA_FULL_ERROR"] = "1"
        hydra_source.register()
        application(job)()


def run(overrides: Sequence[str] = (), *, run_job: RunJob | None = None) -> JobResult:
    """Runs the job that `python -m cfx OVERRIDES` runs.

    It runs in this process, and writes into a new output folder. What belongs to the process is
    afterwards as it was: see `cfx.core.guest`.

    Args:
        overrides: as on the command line: `["model=w99", "data.max_pairs=10"]`.

    Raises:
        CfxError: whatever the command line would print and exit 2 for.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"give a list of overrides: cfx.run({overrides.split()!r})")
    with visit():
        return _compose_and_run(overrides, run_job)


def _compose_and_run(overrides: Sequence[str], run_job: RunJob | None) -> JobResult:
    """Does what `run` promises."""
    try:
        config = hydra_source.composed(overrides)
        values = hydra_source.plain(config)
        with hydra_source.resolving(config):
            folder = _new_folder(Path(str(config.hydra.run.dir)).absolute())
    except Exception as error:
        if is_user_error(error) and not isinstance(error, CfxError):
            raise ConfigError(explain(error, overrides)) from None
        raise
    with _log_file(folder / "cfx.log"), _blaming():
        return (run_job or _own_job())(_job_config(values), folder)


def wants_traceback(arguments: Sequence[str]) -> bool:
    """Says whether the user asked for tracebacks even of their own mistakes."""
    for name in ("CFX_TRACEBACK", "HYDRA_FULL_ERROR"):
        if os.environ.get(name, "") not in {"", "0"}:
            return True
    for argument in arguments:
        if argument.startswith("hydra.verbose=") and not argument.lower().endswith("=false"):
            return True
    return False


# What these import takes a tenth of a second and more, which `--help` does not wait for.
def _job_config(values: Mapping[str, Any]) -> JobConfig:
    from cfx.results.config import JobConfig

    return JobConfig.of(values)


def _own_job() -> RunJob:
    from cfx.app.job.run import run_job

    return run_job


@contextlib.contextmanager
def _blaming() -> Iterator[None]:
    """Attributes what a plugin raises in the block to its distribution.

    Raises:
        CfxError: with the plugin's distribution, or because memory ran out.
    """
    try:
        yield
    except CfxError:
        raise
    except (Exception, SystemExit) as error:  # a plugin may raise anything
        if signal_behind(error) is not None:
            raise
        blamed: CfxError | None = blame(error)
        if blamed is None and is_out_of_memory(error):
            blamed = CfxError(
                f"memory ran out ({registry.in_words(error)}); take fewer pairs (data.max_pairs),"
                " smaller networks or a smaller simulator.memory_mb"
            )
        if blamed is None:
            raise
        detail = "".join(traceback.format_exception(error)).rstrip()
        log.error("%s\n%s", blamed, detail, extra={"file_only": True})
        raise blamed from error


def _is_done(earlier: JobStatus | None, status: JobStatus) -> TypeGuard[JobStatus]:
    """Says whether a job ended well before, with all that its results depend on as it is now."""
    return earlier is not None and earlier.code == 0 and earlier.fingerprint == status.fingerprint


def _below(detail: str) -> str:
    """Returns a traceback so that it follows a message on a line of its own."""
    if not detail:
        return ""
    return f"\n{detail}"


def _interrupted(signalled: BaseException) -> int:
    """Says that a signal ended the program; returns its exit code."""
    if isinstance(signalled, Terminated):
        print("terminated; what was finished is kept", file=sys.stderr)
        return TERMINATED
    print("interrupted; what was finished is kept", file=sys.stderr)
    return INTERRUPTED


def _metric(metrics: Mapping[str, float]) -> float:
    from cfx.evaluation.headline import main_error

    return main_error(metrics)


def _preset_behind(status: JobStatus, values: Mapping[str, Any]) -> str:
    """Returns, to go after a message about a key, the preset that set it; "" if none did."""
    key = re.match(r"\w+(\.\w+)+", status.message)
    if key is None:
        return ""
    for override in status.overrides:
        if override.lstrip("+").startswith(f"{key[0]}="):
            return ""
    choices = HydraConfig.get().runtime.choices
    path = hydra_source.preset_behind(key[0], choices, values)
    if path is None:
        return ""
    return f" It is set in {path}."


def _value_of_failed(config: DictConfig, sweeper: DictConfig, status: JobStatus) -> float:
    """Returns what Hydra's sweeper is told of a job that failed: `failed_value`, or NaN.

    Raises:
        JobFailedError: nothing else is to be said, and the sweeper optimises. NaN would end such a
            sweep; what a job raises is counted by `hydra.sweeper.max_failure_rate`.
    """
    value = config.get("failed_value")
    if isinstance(value, int | float):
        return float(value)
    if "BasicSweeper" in str(sweeper.get("_target_")):
        return float("nan")
    raise JobFailedError(f"job {status.number} failed: {status.message}")


def _report(error: BaseException | None, overrides: Sequence[str], show_traceback: bool) -> int:
    """Prints a user's mistake as a sentence, a bug as a traceback; returns the exit code."""
    assert error is not None
    # Joblib's errors are known by their names, because importing it takes a while.
    if type(error).__name__ in {"TerminatedWorkerError", "BrokenProcessPool"}:
        text = (
            "a worker process was killed, perhaps because memory ran out:"
            " hydra.launcher.n_jobs=N makes fewer at a time"
        )
        print(text, file=sys.stderr)
        return 1
    mistake = is_user_error(error)
    if show_traceback or not mistake:
        traceback.print_exception(error)
    if not mistake:
        return 1
    print(printable(without_passwords(explain(error, overrides))), file=sys.stderr)
    return 2


def _new_folder(folder: Path) -> Path:
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
def _log_file(path: Path) -> Iterator[None]:
    """Writes cfx's messages into a file."""
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
