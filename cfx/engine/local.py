"""The engine `local`: this machine's cores."""

from __future__ import annotations

import multiprocessing
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from cfx.engine.base import Engine, Report, ResultT, ShardT, Work
from cfx.engine.counting import Counted, counted
from cfx.errors import EngineError
from cfx.simulation.threads import cores, limit_cores


class LocalEngine(Engine):
    """Works in this process; work that uses one core runs in a process for each core.

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
        yield from _in_processes(work, shards, report, cores())


def _in_processes(
    work: Work[ShardT, ResultT], shards: Iterable[ShardT], report: Report, processes: int
) -> Generator[tuple[int, ResultT], None, None]:
    """Works on as many shards at once as there are processes."""
    # A forked process would inherit locks of threads that it does not have.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        processes, mp_context=context, initializer=limit_cores, initargs=(1,)
    )
    running: dict[Future[Counted[ResultT]], int] = {}
    try:
        for number, shard in enumerate(shards):
            running[pool.submit(counted, work, shard)] = number
            if len(running) >= processes:
                yield from _finished(running, report)
        while running:
            yield from _finished(running, report)
    except BrokenProcessPool as error:
        raise EngineError(
            "a worker process was killed, perhaps because memory ran out; cores=N makes fewer at a"
            " time, and what was finished is kept"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _finished(
    running: dict[Future[Counted[ResultT]], int], report: Report
) -> Generator[tuple[int, ResultT], None, None]:
    """Yields what is done, at least one; it leaves `running`."""
    done, _ = wait(running, return_when=FIRST_COMPLETED)
    for future in done:
        number = running.pop(future)
        found = future.result()
        report(found.units)
        yield number, found.result
