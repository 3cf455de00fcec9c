"""An engine: where a job's work is done. This one has threads of the job's process.

Calibration, training and evaluation cut their work into shards that need nothing of one another,
and call `map` once for each stretch of work.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from cfx.plugin import Engine, Settings
from pydantic import Field


class ThreadPoolSettings(Settings):
    """Settings of `thread_pool`."""

    threads: int = Field(2, ge=1, description="shards that are worked on at once")


class ThreadPool(Engine):
    """Works on several shards at once, each in a thread of this process."""

    schema = ThreadPoolSettings
    settings: ThreadPoolSettings
    distributes = True

    def map(
        self, work: Any, shards: Iterable[Any], report: Any, *, shares_cores: bool = True
    ) -> Generator[tuple[int, Any], None, None]:
        pool = ThreadPoolExecutor(self.settings.threads)
        running: dict[Future[Any], int] = {}
        try:
            for number, shard in enumerate(shards):
                running[pool.submit(work, shard, report)] = number
                if len(running) >= self.settings.threads:
                    yield from self._finished(running)
            while running:
                yield from self._finished(running)
        finally:
            pool.shutdown(cancel_futures=True)

    def _finished(self, running: dict[Future[Any], int]) -> Generator[tuple[int, Any], None, None]:
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield running.pop(future), future.result()
