"""Processes of this machine that work for this one, and end with it, however it ends.

They are loky's: they run no line of the script that a user started, so that a script needs no
`if __name__ == "__main__"`. They share no lock with this process, as forked ones would. This module
imports nothing heavy: workers begin here.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import loky
from loky.backend import get_context

from cfx.core.signals import ignore_signals

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
