"""Processes of this machine: how signals end this one, and workers that end with it.

Workers are loky's: they run no line of the script that a user started, so that a script needs no
`if __name__ == "__main__"`. They share no lock with this process, as forked ones would. This
module imports nothing heavy: workers begin here.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from cfx.errors import Terminated

if TYPE_CHECKING:
    import loky


class _Handler:
    """Raises at a signal, and remembers that it did.

    Args:
        kind: what is raised.
    """

    def __init__(self, kind: type[BaseException]) -> None:
        self.kind = kind
        self.raised: BaseException | None = None

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.raised = self.kind()
        raise self.raised


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Turns SIGTERM into `Terminated`, and Ctrl-C into a KeyboardInterrupt that is remembered.

    Whoever ignores Ctrl-C, or handles it by themselves, goes on to do so.
    """
    if isinstance(signal.getsignal(signal.SIGTERM), _Handler):
        yield
        return
    kinds: dict[int, type[BaseException]] = {signal.SIGTERM: Terminated}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        kinds[signal.SIGINT] = KeyboardInterrupt
    before = {}
    try:
        for number, kind in kinds.items():
            before[number] = signal.signal(number, _Handler(kind))
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def raise_if_signalled() -> None:
    """Raises again what a signal raised in code that went on or failed otherwise.

    OmegaConf and C code, such as pydantic's and that which imports a module, do so.

    Raises:
        Terminated, KeyboardInterrupt: SIGTERM or Ctrl-C arrived in a block of `terminable`.
    """
    arrived = _arrived()
    if arrived is not None:
        raise arrived


def _arrived() -> BaseException | None:
    """Returns what a signal raised in a block of `terminable`."""
    for number in (signal.SIGTERM, signal.SIGINT):
        handler = signal.getsignal(number)
        if isinstance(handler, _Handler) and handler.raised is not None:
            return handler.raised
    return None


def signal_behind(error: BaseException) -> BaseException | None:
    """Returns the Ctrl-C or SIGTERM that an error comes from.

    Lightning answers Ctrl-C with sys.exit, and a library that a signal hits while it is imported or
    tidies up may raise an error of its own.
    """
    current: BaseException | None = error
    while current is not None:
        if isinstance(current, KeyboardInterrupt | Terminated):
            return current
        current = current.__context__
    return _arrived()


def ignore_signals() -> None:
    """Ignores Ctrl-C and SIGTERM from now on, at the end of the program."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


_ORPHAN = 1.0
"""Seconds between a worker's looks at whether the job is still there."""

_ENVIRONMENT = {"OMP_NUM_THREADS": "1"}
"""Of workers: threads that spin would slow down the other processes."""


def worker_pool(
    count: int,
    begin: Callable[..., None],
    *arguments: object,
    folder: Path | None = None,
) -> loky.ProcessPoolExecutor:
    """Returns an executor whose processes start with the first call that it is given.

    Any number of threads may give it calls.

    Args:
        count: processes.
        begin: called with `arguments` in each process before anything else.
        folder: of temporary files; a process that has outlived this one removes it.

    Raises:
        OSError, ImportError: this system cannot have any.
    """
    import loky
    from loky.backend import get_context

    # One that has grown is replaced by a new one, of which loky warns.
    warnings.filterwarnings("ignore", message=r"A worker (stopped|was restarted) while some jobs")
    return loky.ProcessPoolExecutor(
        count,
        context=get_context("loky"),
        timeout=None,  # however long they have nothing to do
        initializer=_begin,
        initargs=(os.getpid(), folder, begin, arguments),
        env=_ENVIRONMENT,
    )


def _begin(
    job: int, folder: Path | None, begin: Callable[..., None], arguments: tuple[Any, ...]
) -> None:
    """Prepares a worker of a job's process."""
    # The job stops its workers itself.
    ignore_signals()
    threading.Thread(target=_end_with, args=(job, folder), daemon=True).start()
    begin(*arguments)


def _end_with(job: int, folder: Path | None) -> None:
    """Ends this worker once the job is gone."""
    while os.getppid() == job:
        time.sleep(_ORPHAN)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)
