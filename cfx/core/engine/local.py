"""The engine `local`: this machine's cores."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from cfx.core.engine.base import Engine, Report, ResultT, ShardT, Work
from cfx.core.threads import cores


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
        # Imported where it is used: most work needs no other process.
        from cfx.core.engine.processes import in_processes

        yield from in_processes(work, shards, report, cores())
