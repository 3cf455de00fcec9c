"""The engine `local`: this machine's cores."""

from __future__ import annotations

import itertools
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any, Generic

from loky.backend import get_context
from loky.process_executor import BrokenProcessPool

from cfx.core.engine import Engine, Report, ResultT, ShardT, Work
from cfx.core.processes import worker_pool
from cfx.core.threads import cores, limit_cores, one_core, one_thread
from cfx.errors import EngineError


class LocalEngine(Engine):
    """Works in this process; work that uses one core runs in a process for each core, this one too.

    `cores` says how many cores there are for it.
    """

    def map(
        self,
        work: Work[ShardT, ResultT],
        shards: Iterable[ShardT],
        report: Report,
        *,
        shares_cores: bool = True,
    ) -> Generator[tuple[int, ResultT], None, None]:
        if shares_cores or cores() == 1:
            for number, shard in enumerate(shards):
                yield number, work(shard, report)
            return
        yield from in_processes(work, shards, report, cores())


_LOOK = 0.5
"""Seconds between looks at the workers' progress."""


_UNITS: list[Any] = []
"""In a worker: the queue that its progress goes to."""


def in_processes(
    work: Work[ShardT, ResultT], shards: Iterable[ShardT], report: Report, processes: int
) -> Generator[tuple[int, ResultT], None, None]:
    """Works on as many shards at once as there are processes; as `Engine.map`.

    This process is one of them: it has imported already what a worker has to import first. Each
    time that its work reports progress, it looks after the others. They end when the caller stops
    listening, is interrupted or dies.

    Args:
        work: uses one core.
        shards: made one after the other, as processes become free.
        report: called with the workers' progress, as it is made.
        processes: how many at most, two or more.

    Raises:
        EngineError: a worker was killed.
    """
    workers = _Workers(work, report, processes - 1)
    is_done = False
    try:
        yield from _work_along(work, enumerate(shards), workers)
        is_done = True
    except BrokenProcessPool as error:
        raise EngineError(
            "a worker process was killed, perhaps because memory ran out; cores=N makes fewer at a"
            " time, and what was finished is kept"
        ) from error
    finally:
        workers.end(kill=not is_done)


def _work_along(
    work: Work[ShardT, ResultT],
    source: Iterator[tuple[int, ShardT]],
    workers: _Workers[ShardT, ResultT],
) -> Generator[tuple[int, ResultT], None, None]:
    """Yields results of the workers and of this process."""

    def report_and_hand_out(units: int) -> None:
        workers.report(units)
        workers.check()
        workers.hand_out(source)

    workers.hand_out(source)
    for number, shard in source:
        with one_thread(), one_core():
            result = work(shard, report_and_hand_out)
        yield number, result
        yield from workers.finished()
        workers.hand_out(source)
    while workers.running:
        workers.wait()
        yield from workers.finished()
        workers.hand_out(source)
    workers.report(0)


class _Workers(Generic[ShardT, ResultT]):
    """Other processes, each at one shard."""

    def __init__(self, work: Work[ShardT, ResultT], report: Report, count: int) -> None:
        self._units = get_context("loky").SimpleQueue()
        self._pool = worker_pool(count, _begin, self._units)
        self._work = work
        self._report = report
        self._count = count
        self.running: dict[Future[ResultT], int] = {}
        """Results that are still to come or to be fetched, and the numbers of their shards."""
        # They import what they need while the first shard is made here.
        for _ in range(count):
            self._pool.submit(_import, work)

    def hand_out(self, source: Iterator[tuple[int, ShardT]]) -> None:
        """Gives a shard to each worker that is free."""
        busy = sum(not future.done() for future in self.running)
        for number, shard in itertools.islice(source, self._count - busy):
            self.running[self._pool.submit(_do, self._work, shard)] = number

    def report(self, units: int) -> None:
        """Reports the units done here, and those that workers have done since."""
        self._report(units)
        while not self._units.empty():
            self._report(self._units.get())

    def check(self) -> None:
        """Raises the error of a worker whose result is not fetched yet."""
        for future in self.running:
            if future.done():
                future.result()

    def wait(self) -> None:
        """Waits until one of them has a result."""
        done: set[Future[ResultT]] = set()
        while not done:
            done, _ = wait(self.running, timeout=_LOOK, return_when=FIRST_COMPLETED)
            self.report(0)

    def finished(self) -> Iterator[tuple[int, ResultT]]:
        """Yields the results that have arrived."""
        for future in list(self.running):
            if future.done():
                number = self.running.pop(future)
                yield number, future.result()

    def end(self, *, kill: bool) -> None:
        """Ends the workers; one that exits normally also ends its libraries' processes."""
        self._pool.shutdown(wait=True, kill_workers=kill)


def _begin(units: Any) -> None:
    """Prepares a worker; `units` is the queue that progress goes to."""
    limit_cores(1)
    _UNITS[:] = [units]


def _import(_work: Work[ShardT, ResultT]) -> None:
    """Imports the module of some work, which is found as the work arrives."""


def _do(work: Work[ShardT, ResultT], shard: ShardT) -> ResultT:
    """Does the work of one shard in a worker."""
    return work(shard, _UNITS[0].put)
