"""Work in processes of this machine, one shard in each at a time.

The processes are loky's: they run no line of the script that a user started, so that a script needs
no `if __name__ == "__main__"`. They share no lock with this process, as forked ones would.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any

import loky
from loky.backend import get_context
from loky.process_executor import BrokenProcessPool

from cfx.engine.base import Report, ResultT, ShardT, Work
from cfx.errors import EngineError
from cfx.simulation.threads import limit_cores

_LOOK = 0.5
"""Seconds between looks at the workers' progress."""

_ORPHAN = 1.0
"""Seconds between a worker's looks at whether the job is still there."""

_UNITS: list[Any] = []
"""In a worker: the queue that its progress goes to."""


def in_processes(
    work: Work[ShardT, ResultT], shards: Iterable[ShardT], report: Report, processes: int
) -> Generator[tuple[int, ResultT], None, None]:
    """Works on as many shards at once as there are processes; as `Engine.map`.

    The workers end when the caller stops listening, is interrupted or dies.

    Args:
        work: uses one core.
        shards: made one after the other, as processes become free.
        report: called with the workers' progress, as it is made.
        processes: how many at most.

    Raises:
        EngineError: a worker was killed.
    """
    # A worker that has grown is replaced by a new one, of which loky warns.
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given")
    context = get_context("loky")
    units = context.SimpleQueue()
    pool = loky.ProcessPoolExecutor(
        processes,
        context=context,
        initializer=_begin,
        initargs=(units, os.getpid()),
        # Threads that spin would slow down the other processes.
        env={"OMP_NUM_THREADS": "1"},
    )
    running: dict[Future[ResultT], int] = {}
    is_done = False
    try:
        for number, shard in enumerate(shards):
            running[pool.submit(_do, work, shard)] = number
            if len(running) >= processes:
                yield from _finished(running, units, report)
        while running:
            yield from _finished(running, units, report)
        _drain(units, report)
        is_done = True
    except BrokenProcessPool as error:
        raise EngineError(
            "a worker process was killed, perhaps because memory ran out; cores=N makes fewer at a"
            " time, and what was finished is kept"
        ) from error
    finally:
        # A worker that ends by itself also ends what libraries have started in it.
        pool.shutdown(wait=True, kill_workers=not is_done)


def _finished(
    running: dict[Future[ResultT], int], units: Any, report: Report
) -> Generator[tuple[int, ResultT], None, None]:
    """Yields what is done, at least one; it leaves `running`."""
    done: set[Future[ResultT]] = set()
    while not done:
        done, _ = wait(running, timeout=_LOOK, return_when=FIRST_COMPLETED)
        _drain(units, report)
    for future in done:
        number = running.pop(future)
        yield number, future.result()


def _drain(units: Any, report: Report) -> None:
    """Reports what workers have done since."""
    while not units.empty():
        report(units.get())


def _begin(units: Any, job: int) -> None:
    """Prepares a worker."""
    limit_cores(1)
    _UNITS[:] = [units]
    # The job stops its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(job,), daemon=True).start()


def _end_with(job: int) -> None:
    """Ends this worker once the job is gone, however it ended."""
    while os.getppid() == job:
        time.sleep(_ORPHAN)
    os._exit(1)


def _do(work: Work[ShardT, ResultT], shard: ShardT) -> ResultT:
    """Does the work of one shard in a worker."""
    return work(shard, _UNITS[0].put)
