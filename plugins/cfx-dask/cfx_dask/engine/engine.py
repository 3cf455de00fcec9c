"""The engine `dask`: a Dask cluster that runs already, or one that the job starts for itself.

Dask development team (2016), *Dask: Library for dynamic task scheduling*, https://dask.org
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from contextlib import closing
from typing import Any, ClassVar

from cfx.plugin import Engine, Settings, engine
from cfx_dask.engine.clusters import require_installed
from cfx_dask.engine.connection import Connection
from cfx_dask.engine.run import Run
from cfx_dask.engine.settings import DaskSettings


class DaskEngine(Engine):
    """Runs shards as Dask futures, one on each core of the cluster.

    A worker that dies is replaced and its shard done again, as is one whose scheduler was started
    again. Whatever is finished lies in the cache, so that a job that had to stop goes on from it.

    Raises:
        NotInstalledError: Dask is not installed.
    """

    schema: ClassVar[type[Settings]] = DaskSettings
    settings: DaskSettings
    distributes = True

    def __init__(self, settings: Settings | None = None, **options: Any) -> None:
        super().__init__(settings, **options)
        require_installed(self.settings)
        self._connection = Connection(self.settings)

    def map(
        self,
        work: engine.Work[engine.ShardT, engine.ResultT],
        shards: Iterable[engine.ShardT],
        report: engine.Report,
        *,
        shares_cores: bool = True,
    ) -> Generator[tuple[int, engine.ResultT], None, None]:
        run = Run(self._connection, self.settings, work, report)
        with closing(run.results(shards)) as results:
            yield from results

    def close(self) -> None:
        self._connection.close()
