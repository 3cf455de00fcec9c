"""What runs on a worker."""

from __future__ import annotations

from cfx.engine.base import ResultT, ShardT, Unfit, Work
from cfx.engine.dask.counting import Counted, counted


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


def work_on(work: Work[ShardT, ResultT], shard: ShardT) -> Counted[ResultT]:
    """Does the work of one shard on one core: a worker has one for each of its threads.

    Raises:
        WorkerTrouble: this worker cannot do it; perhaps another one can.
    """
    import torch
    from distributed import get_worker

    from cfx.simulation.threads import limit_cores

    limit_cores(1)
    torch.set_num_threads(1)
    try:
        return counted(work, shard)
    except Unfit as error:
        raise WorkerTrouble(str(error), get_worker().address) from error
    except (OSError, MemoryError) as error:
        raise WorkerTrouble(f"{type(error).__name__}: {error}", get_worker().address) from error
