"""What runs on a worker."""

from __future__ import annotations

from collections.abc import Mapping

from cfx.errors import EngineError
from cfx.plugin import engine, threads
from cfx_dask.engine.code import differing, installed_code
from cfx_dask.engine.counting import Counted, counted


class WorkerTrouble(Exception):  # noqa: N818 - the shard is well, its worker is not
    """A worker cannot work: its disk is full, or its memory.

    Attributes:
        worker: its address.
    """

    def __init__(self, message: str, worker: str) -> None:
        super().__init__(message, worker)
        self.worker = worker

    def __str__(self) -> str:
        return f"{self.worker}: {self.args[0]}"


def work_on(
    work: engine.Work[engine.ShardT, engine.ResultT], shard: engine.ShardT, code: Mapping[str, str]
) -> Counted[engine.ResultT]:
    """Does the work of one shard on one core: a worker has one for each of its threads.

    Args:
        work: what is done.
        shard: with what.
        code: of the job, as `installed_code` returns it.

    Raises:
        EngineError: this worker has other code than the job.
        WorkerTrouble: this worker cannot do it; perhaps another one can.
    """
    import torch
    from distributed import get_worker

    others = differing(code, installed_code())
    if others:
        raise EngineError(
            f"the worker {get_worker().address} has another {' and '.join(others)} than this job;"
            " install the same on all workers, and start them again"
        )
    threads.own_cores(1)
    threads.limit_cores(None)  # what a sweep's job asked for that ran here before
    torch.set_num_threads(1)
    try:
        return counted(work, shard)
    except engine.Unfit as error:
        raise WorkerTrouble(str(error), get_worker().address) from error
    except (OSError, MemoryError) as error:
        raise WorkerTrouble(f"{type(error).__name__}: {error}", get_worker().address) from error
