"""The Hydra application: composes, runs one job or many, and ends in an exit code and one message.

Hydra's own error handling prints tracebacks and exits with 1. `HYDRA_FULL_ERROR` is therefore set
for the time of the call, so that exceptions reach this module. A job itself never raises into
Hydra; it leaves a `JobStatus`, in a multirun as `outcome.json` in its folder, which is how worker
processes and other machines report too. So one failed job stops no other, and a multirun that was
broken off goes on where it stopped: see `cfx.app.sweep`.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
import traceback
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx.app import hydra_source, nodes
from cfx.app.sweep import Refused, SweepFolder, worker_of
from cfx.app.sweep.folder import (
    STATUS,
    JobStatus,
    Record,
    fingerprint,
    judge_of_folder,
    metrics_of,
    new_folder,
    only_one,
)
from cfx.app.user_errors import explain, explained, is_user_error, refuse_choices
from cfx.core.console import console_logging
from cfx.core.guest import default_torch, guest, in_turn, own_hydra
from cfx.core.memory import is_out_of_memory
from cfx.core.processes import raise_if_signalled, signal_behind, terminable
from cfx.core.progress import no_bars_on_terminals
from cfx.core.registry import blame
from cfx.core.storage import is_url
from cfx.errors import (
    CfxError,
    ConfigError,
    JobFailedError,
    Terminated,
    in_words,
    printable,
    without_passwords,
)

if TYPE_CHECKING:
    from cfx.results.config import JobConfig
    from cfx.results.result import Result

log = logging.getLogger(__name__)

RunJob = Callable[["JobConfig", Path], "Result"]
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
            The error by which the job is judged, for sweepers that optimise; NaN if it failed.

        Raises:
            JobFailedError: it failed, and the sweeper optimises: it counts failures.
        """
        raise_if_signalled()
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
            log.error("job failed: %s", _in_full(self.status), extra={"file_only": True})
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
            overrides = " ".join(blank.overrides)
            log.error("job %d (%s) failed: %s", blank.number, overrides, _in_full(self.status))
            return _value_of_failed(config, hydra_config.sweeper, self.status)
        return metric

    def _attempt(
        self, config: DictConfig, folder: Path, blank: JobStatus, sweep: str
    ) -> tuple[float, JobStatus]:
        """Runs a job, of a multirun if `sweep` names one, or finds that it was done."""
        from cfx.evaluation.headline import main_error

        began = time.monotonic()
        values: Any = {}
        try:
            values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            if sweep:
                if values.get("tracking", {}).get("sweep", "") is None:
                    values["tracking"]["sweep"] = sweep
                blank = replace(blank, fingerprint=fingerprint(values))
                earlier = JobStatus.read(folder)
                if earlier and earlier.code == 0 and earlier.fingerprint == blank.fingerprint:
                    log.info("job %d (%s) was done before", blank.number, " ".join(blank.overrides))
                    status = replace(blank, seconds=earlier.seconds, before=True)
                    judge = judge_of_folder(folder).name
                    return main_error(metrics_of(folder), judge), status
                (folder / STATUS).unlink(missing_ok=True)  # what it says is no longer so
            result = _run_job(values, folder, self.run_job)
        except (Exception, SystemExit) as error:
            status = self._failed(error, blank)
            if status.code == CfxError.exit_code:
                status = replace(status, message=status.message + _preset_behind(status, values))
            return float("nan"), replace(status, seconds=time.monotonic() - began)
        measured = main_error(result.metrics, result.judge.name)
        return measured, replace(blank, seconds=time.monotonic() - began)

    def _failed(self, error: BaseException, blank: JobStatus) -> JobStatus:
        """Returns the status of a job that ended in an error; raises a signal that caused it."""
        signalled = signal_behind(error)
        if signalled is not None:
            raise signalled from None
        detail = traceback.format_exc().rstrip()
        if isinstance(error, CfxError | OmegaConfBaseException):
            detail = detail if self.show_traceback else ""
            return replace(blank, code=2, message=explain(error, ()), detail=detail)
        # A bug: its traceback is printed, and the other jobs go on.
        message = f"{type(error).__name__}: {error}"
        if isinstance(error, SystemExit):
            message = f"the job called sys.exit({error.code!r})"
        return replace(blank, code=1, message=message, detail=detail)


def start(arguments: Sequence[str], *, run_job: RunJob | None = None) -> int:
    """Lets Hydra compose the configuration and run the job or the jobs; prints each message once.

    Args:
        arguments: of the command line.
        run_job: runs a job; None: cfx's own.

    Returns:
        The exit code.

    Raises:
        ConfigError: Hydra would act upon an argument before a job can refuse it.
    """
    _refuse(arguments)
    job = JobFunction(run_job, uuid.uuid4().hex, wants_traceback(arguments))
    SweepFolder.take()
    application = hydra.main(
        config_path=str(nodes.conf_dir()), config_name="config", version_base="1.3"
    )
    code = 0
    try:
        with guest(), own_hydra(), terminable():
            sys.argv = ["cfx", *arguments]
            os.environ["HYDRA_FULL_ERROR"] = "1"
            hydra_source.register()
            application(job)()
    except BrokenPipeError:
        raise  # the reader of stdout has gone; `cfx.app.cli.main` knows what that means
    except (Exception, SystemExit, KeyboardInterrupt, Terminated, Refused) as error:
        code = _exit_code(error, arguments, job.show_traceback)
    sweep = SweepFolder.take()
    if sweep is not None:
        return sweep.close(job.multirun, code, interrupted=code in {INTERRUPTED, TERMINATED})
    if job.status is not None and job.status.code:
        print(job.status.detail or job.status.message, file=sys.stderr)
        return job.status.code
    return code


def _refuse(arguments: Sequence[str]) -> None:
    """Refuses what Hydra would act upon before a job can.

    Raises:
        ConfigError: a component is not chosen by its name; a password in `tracking.uri`, which
            Hydra writes into the job's folder; a URL where Hydra would make a folder of that name;
            or a working directory whose name it would take for an interpolation.
    """
    folder = str(Path.cwd())
    if "${" in folder:
        raise ConfigError(
            f"the working directory {folder} holds '${{', which Hydra replaces in paths; start from"
            " another folder"
        )
    refuse_choices(arguments)
    for argument in arguments:
        key, _, value = argument.partition("=")
        public = without_passwords(value)
        if key.lstrip("+") == "tracking.uri" and public != value:
            from cfx.results.config import SAYS_TOO_MUCH

            raise ConfigError(f"tracking.uri={public} {SAYS_TOO_MUCH}")
        if key in {"hydra.run.dir", "hydra.sweep.dir"} and is_url(value.strip("'\"")):
            raise ConfigError(
                f"{key} is a folder of this machine; output.url={public} copies jobs there when"
                " they are done"
            )


def _exit_code(error: BaseException, arguments: Sequence[str], show_traceback: bool) -> int:
    """Returns the exit code after what Hydra ended in, and prints what is to be said of it."""
    if isinstance(error, SystemExit):
        # Hydra exits with 0 after --help and the like, with 1 or argparse's 2 after a message about
        # a wrong flag.
        return 2 if error.code else 0
    overrides = [argument for argument in arguments if not argument.startswith("-")]
    if isinstance(error, Refused):
        return _report(error.__cause__, overrides, show_traceback)
    signalled = signal_behind(error)
    if signalled is not None:
        return _interrupted(signalled)
    return _report(error, overrides, show_traceback)


def run(overrides: Sequence[str] = (), *, run_job: RunJob | None = None) -> Result:
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
    with in_turn(), guest(), default_torch(), no_bars_on_terminals():
        with explained(overrides):
            config = hydra_source.composed(overrides)
            values = hydra_source.plain(config)
            with hydra_source.resolving(config):
                folder = new_folder(Path(str(config.hydra.run.dir)).absolute())
        messages = logging.FileHandler(folder / "cfx.log", encoding="utf-8")
        messages.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        with console_logging(handler=messages):
            return _run_job(values, folder, run_job)


def wants_traceback(arguments: Sequence[str]) -> bool:
    """Says whether the user asked for tracebacks even of their own mistakes."""
    for name in ("CFX_TRACEBACK", "HYDRA_FULL_ERROR"):
        if os.environ.get(name, "") not in {"", "0"}:
            return True
    for argument in arguments:
        if argument.startswith("hydra.verbose=") and not argument.lower().endswith("=false"):
            return True
    return False


def _run_job(values: Mapping[str, Any], folder: Path, run_job: RunJob | None) -> Result:
    """Runs a job; what a plugin raises is attributed to its distribution.

    Raises:
        CfxError: the user's mistake, with the plugin's distribution; or memory ran out.
    """
    # Importing these takes a tenth of a second and more, which `--help` does not wait for.
    from cfx.app.job.run import run_job as run_own_job
    from cfx.results.config import JobConfig

    try:
        return (run_job or run_own_job)(JobConfig.of(values), folder)
    except CfxError:
        raise
    except (Exception, SystemExit) as error:  # a plugin may raise anything
        if signal_behind(error) is not None:
            raise
        blamed: CfxError | None = blame(error)
        if blamed is None and is_out_of_memory(error):
            blamed = CfxError(
                f"memory ran out ({in_words(error)}); take fewer pairs (data.max_pairs),"
                " smaller networks or a smaller simulator.memory_mb"
            )
        if blamed is None:
            raise
        detail = "".join(traceback.format_exception(error)).rstrip()
        log.error("%s\n%s", blamed, detail, extra={"file_only": True})
        raise blamed from error


def _in_full(status: JobStatus) -> str:
    """Returns the message of a job that failed, its traceback below."""
    return f"{status.message}\n{status.detail}".rstrip()


def _interrupted(signalled: BaseException) -> int:
    """Says that a signal ended the program; returns its exit code."""
    terminated = isinstance(signalled, Terminated)
    word = "terminated" if terminated else "interrupted"
    print(f"{word}; what was finished is kept", file=sys.stderr)
    return TERMINATED if terminated else INTERRUPTED


def _preset_behind(status: JobStatus, values: Mapping[str, Any]) -> str:
    """Returns, to go after a message about a key, the preset that set it; "" if none did."""
    key = re.match(r"\w+(\.\w+)+", status.message)
    if key is None:
        return ""
    for override in status.overrides:
        if override.lstrip("+").startswith(f"{key[0]}="):  # the user did
            return ""
    group = key[0].partition(".")[0]
    choice, node = HydraConfig.get().runtime.choices.get(group), values.get(group)
    if not isinstance(choice, str) or not isinstance(node, Mapping) or node.get("name") == choice:
        return ""
    for folder in (nodes.conf_dir(), *hydra_source.plugin_conf_dirs().values()):
        path = Path(folder) / group / f"{choice}.yaml"
        if path.is_file():
            return f" It is set in {path}."
    return ""


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
