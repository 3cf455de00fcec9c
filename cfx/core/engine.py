"""The contract of an engine: it runs a job's shards, wherever its workers are.

A job cuts what it has to do into shards: parts that need nothing of one another, such as the
calibrations of a thousand drivers. An engine calls one function for each of them. It knows nothing
of what they are, so that calibration, training and evaluation use it alike.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable
from typing import ClassVar, TypeVar

from cfx.core.component import Component

__all__ = [
    "Report",
    "ResultT",
    "ShardT",
    "Unfit",
    "Work",
]
"""What plugins may use, as `cfx.plugin.engine`."""


ShardT = TypeVar("ShardT")
"""What a shard of the work is."""

ResultT = TypeVar("ResultT")
"""What the work on a shard gives."""

Report = Callable[[int], None]
"""Called with how many more units of work are done."""

Work = Callable[[ShardT, Report], ResultT]
"""Work on one shard: a module's function, which a worker can import by its name."""


class Unfit(Exception):  # noqa: N818 - the shard is well, its worker is not
    """A worker cannot do a shard as the job would do it here; another one perhaps can."""


class Engine(Component):
    """Base of every engine.

    Life cycle: a job makes its engine at the start, and then calls `map` for each stretch of work.
    What an engine needs, such as processes or a connection, it makes when `map` is first called. A
    job that finds everything in the cache needs none. The job calls `close` at its end.

    A shard is cut and solved in the same way wherever it runs, so that every engine gives the same
    numbers as `local`, to the last bit on processors of one kind.

    Attributes:
        distributes: it works on several shards at once, so that it should be given many. `local`
            shares each single shard among this machine's cores instead.
    """

    kind = "engine"
    distributes: ClassVar[bool] = False

    @abstractmethod
    def map(
        self,
        work: Work[ShardT, ResultT],
        shards: Iterable[ShardT],
        report: Report,
        *,
        shares_cores: bool = True,
    ) -> Generator[tuple[int, ResultT], None, None]:
        """Does independent work.

        Args:
            work: called once for each shard, with the shard and with what it reports progress to.
                It may be called again for a shard whose worker was lost, or raised `Unfit`, an
                `OSError` or a `MemoryError`, so it changes nothing outside. Where workers are other
                processes, it, the shards and the results are pickled.
            shards: made one after the other, not long before they are worked on.
            report: called with how many units are done; they add up, also where a shard is done
                again.
            shares_cores: `work` uses all of a machine's cores by itself. Work that uses one core
                says False, and an engine may then run several on one machine.

        Yields:
            The number of each shard and its result, as soon as it is there, in any order. Closing
            the generator cancels the rest.

        Raises:
            CfxError: what `work` raises is raised again; or the workers are lost for good.
        """

    def close(self) -> None:
        """Ends workers and closes connections; `map` may make them again."""
