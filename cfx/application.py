"""The Hydra application: composes, runs one job or many, and turns whatever happens into an exit code and one clear message.

Hydra's own error handling prints tracebacks and exits with 1, so `HYDRA_FULL_ERROR` is set for the time of the call: exceptions
then reach this module. A job itself never raises into Hydra; it leaves an `Outcome`, in a multirun as `outcome.json` in its
folder, which is how worker processes and other machines report too. So one failed job stops no other.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import traceback
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx import hydra_source, nodes
from cfx.errors import CfxError, ConfigError
from cfx.mistakes import explain, is_mistake

if TYPE_CHECKING:
    from cfx.job import JobResult

log = logging.getLogger(__name__)

JOB = "cfx.job:run_job"
"""`run_job(config: JobConfig, folder: Path) -> JobResult`; imported when a job starts."""

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM."""

OUTCOME = "outcome.json"
"""What each job of a multirun leaves in its folder."""


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Attributes:
        code: exit code: 0; 2 for a user's mistake; 1 for a bug.
        message: one sentence for people, empty if all went well.
        detail: the traceback of a bug.
        overrides: what was asked for.
        multirun: tells the jobs of one multirun from those of an earlier one in the same folder.
    """

    code: int
    message: str
    detail: str
    overrides: tuple[str, ...]
    multirun: str


class JobFunction:
    """The function that Hydra calls for each job; it is pickled into worker processes."""

    def __init__(self, target: str, multirun: str, show_traceback: bool) -> None:
        self.target = target
        self.multirun = multirun
        self.show_traceback = show_traceback
        self.outcome: Outcome | None = None

    def __call__(self, config: DictConfig) -> float:
        """Runs one job.

        Returns:
            The policy's RMSE of speed, m/s, for sweepers that optimise; NaN if the job failed.
        """
        hydra_config = HydraConfig.get()
        several = hydra_config.mode == RunMode.MULTIRUN
        folder = Path(hydra_config.runtime.output_dir)
        given: Any = OmegaConf.to_container(hydra_config.overrides.task, resolve=False)  # as typed, `${...}` included
        overrides = tuple(given)
        sweep = str(hydra_config.sweep.dir) if several else ""
        metric, code, message, detail = self._attempt(config, folder, sweep)
        self.outcome = Outcome(code, message, detail, overrides, self.multirun)
        if several:
            text = json.dumps(asdict(self.outcome), indent=2)
            (folder / OUTCOME).write_text(text + "\n", encoding="utf-8")
        if code:
            log.error(
                "job %sfailed: %s%s",
                f"{hydra_config.job.num} ({' '.join(overrides)}) " if several else "",
                message,
                f"\n{detail}" if detail else "",
                extra={"file_only": not several},  # a single job's message is printed by `start`, once
            )
        return metric

    def _attempt(self, config: DictConfig, folder: Path, sweep: str) -> tuple[float, int, str, str]:
        try:
            values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            if sweep and values.get("tracking", {}).get("sweep", "") is None:
                values["tracking"]["sweep"] = sweep
            result = _call(self.target, values, folder)
        except (CfxError, OmegaConfBaseException) as error:
            return float("nan"), 2, explain(error, ()), traceback.format_exc().rstrip() if self.show_traceback else ""
        except SystemExit as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # Lightning answers Ctrl-C with sys.exit
                raise KeyboardInterrupt from None
            return float("nan"), 1, f"the job called sys.exit({error.code!r})", traceback.format_exc().rstrip()
        except Exception as error:  # a bug: its traceback is printed, and the other jobs go on
            return float("nan"), 1, f"{type(error).__name__}: {error}", traceback.format_exc().rstrip()
        return float(result.metrics.get("rmse_speed/policy", float("nan"))), 0, "", ""


class SweepFolder(Callback):
    """Learns where the jobs of a multirun leave their outcomes."""

    _current: ClassVar[Path | None] = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        SweepFolder._current = Path(str(config.hydra.sweep.dir)).absolute()

    @classmethod
    def take(cls) -> Path | None:
        """Returns the folder of the multirun that ran, if one did, and forgets it."""
        folder, cls._current = cls._current, None
        return folder


class _Terminated(BaseException):
    """SIGTERM arrived."""


def start(arguments: Sequence[str], *, target: str = JOB) -> int:
    """Runs the Hydra application and returns its exit code; prints each message once."""
    overrides = [one for one in arguments if not one.startswith("-")]
    show_traceback = wants_traceback(arguments)
    job = JobFunction(target, uuid.uuid4().hex, show_traceback)
    SweepFolder.take()
    try:
        with _process_state(arguments):
            hydra_source.register()
            hydra.main(config_path=str(nodes.conf_dir()), config_name="config", version_base="1.3")(job)()
        code = 0
    except SystemExit as error:
        # Hydra exits with 0 after --help and the like, with 1 or argparse's 2 after a message about a wrong flag.
        code = 0 if not error.code else 2
    except KeyboardInterrupt:
        print("interrupted; what was finished is kept", file=sys.stderr)
        code = INTERRUPTED
    except _Terminated:
        print("terminated; what was finished is kept", file=sys.stderr)
        code = TERMINATED
    except BrokenPipeError:
        raise  # the reader of stdout has gone; `cfx.cli.main` knows what that means
    except Exception as error:  # everything ends as an exit code
        code = _report(error, overrides, show_traceback)
    sweep = SweepFolder.take()
    if sweep is not None:
        return max(_summary(_outcomes(sweep, job.multirun), sweep, code), code, key=_weight)
    if job.outcome is not None and job.outcome.code:
        print(job.outcome.detail or job.outcome.message, file=sys.stderr)
        return job.outcome.code
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
    try:
        config = hydra_source.composed(overrides)
        values = hydra_source.plain(config)
        with hydra_source.resolving(config):
            folder = _fresh(Path(str(config.hydra.run.dir)).absolute())
    except Exception as error:
        if is_mistake(error) and not isinstance(error, CfxError):
            raise ConfigError(explain(error, overrides)) from None
        raise
    with _log_file(folder / "cfx.log"):
        return cast("JobResult", _call(target, values, folder))


def wants_traceback(arguments: Sequence[str]) -> bool:
    """Says whether the user asked for tracebacks even of their own mistakes."""
    asked = any(os.environ.get(name, "") not in {"", "0"} for name in ("CFX_TRACEBACK", "HYDRA_FULL_ERROR"))
    return asked or any(one.startswith("hydra.verbose=") and not one.lower().endswith("=false") for one in arguments)


def _call(target: str, values: Any, folder: Path) -> Any:
    from cfx.config import JobConfig

    job_config = JobConfig.of(values)
    module, _, function = target.partition(":")
    return getattr(import_module(module), function)(job_config, folder)


def _report(error: Exception, overrides: Sequence[str], show_traceback: bool) -> int:
    mistake = is_mistake(error)
    if show_traceback or not mistake:
        traceback.print_exception(error)
    if mistake:
        print(explain(error, overrides), file=sys.stderr)
    return 2 if mistake else 1


def _summary(outcomes: Mapping[Path, Outcome], folder: Path, code: int) -> int:
    """Prints which jobs of a multirun failed and why; returns the exit code."""
    if not outcomes:
        if not code:
            print(f"no job left its outcome in {folder}; see the launcher's own logs", file=sys.stderr)
        return code or 1
    failed = {path: outcome for path, outcome in outcomes.items() if outcome.code}
    print(f"{len(outcomes) - len(failed)} of {len(outcomes)} jobs done; their folders: {folder}")
    for path, outcome in failed.items():
        print(f"failed: {' '.join(outcome.overrides)}: {outcome.message} ({path})", file=sys.stderr)
    return max((outcome.code for outcome in failed.values()), key=_weight, default=0)


def _outcomes(folder: Path, multirun: str) -> dict[Path, Outcome]:
    """Returns the outcome of each job of this multirun, by folder."""
    found = {}
    for path in sorted(folder.rglob(OUTCOME)):
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["multirun"] == multirun:
            found[path.parent] = Outcome(**{**values, "overrides": tuple(values["overrides"])})
    return found


def _weight(code: int) -> int:
    """Orders exit codes: a bug outweighs a user's mistake."""
    return {0: 0, 2: 1, 1: 2}.get(code, 3)


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
                raise ConfigError(f"{folder} is a file; choose another output folder with hydra.run.dir=FOLDER") from None
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
        raise _Terminated

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
