"""One stretch of work on a cluster: shards become futures, lost ones are handed out again."""

from __future__ import annotations

import logging
import queue
import uuid
from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Generic

from cfx.errors import EngineError
from cfx.plugin import engine
from cfx_dask.engine.code import installed_code
from cfx_dask.engine.connection import Connection
from cfx_dask.engine.settings import DaskSettings
from cfx_dask.engine.worker import WorkerTrouble, work_on

log = logging.getLogger(__name__)

_POLL_S = 1.0
"""Seconds between two looks at the cluster while nothing is finished; Ctrl-C is answered then."""


@dataclass
class _Attempt(Generic[engine.ShardT]):
    """A shard that is being worked on.

    Attributes:
        number, shard: which.
        tries: workers that it was on before and that were lost.
        avoid: workers that cannot do it.
    """

    number: int
    shard: engine.ShardT
    tries: int = 0
    avoid: frozenset[str] = frozenset()


class Run(Generic[engine.ShardT, engine.ResultT]):
    """The futures of one call of `DaskEngine.map`.

    Args:
        connection: to the cluster.
        settings: of the engine.
        work: what is done with each shard.
        report: called with the units that are done.
    """

    def __init__(
        self,
        connection: Connection,
        settings: DaskSettings,
        work: engine.Work[engine.ShardT, engine.ResultT],
        report: engine.Report,
    ) -> None:
        self._connection = connection
        self._settings = settings
        self._work = work
        self._report = report
        self._name = f"cfx-{uuid.uuid4().hex[:12]}"
        self._submitted = 0
        self._running: dict[Any, _Attempt[engine.ShardT]] = {}
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def results(
        self, shards: Iterable[engine.ShardT]
    ) -> Generator[tuple[int, engine.ResultT], None, None]:
        """Yields the number and result of each shard as it is finished.

        Raises:
            EngineError: workers or the scheduler are lost for good.
            Exception: what `work` raised.
        """
        source = iter(enumerate(shards))
        more = True
        try:
            while more or self._running:
                while more and len(self._running) < self._room():
                    following = next(source, None)
                    more = following is not None
                    if following is not None:
                        self._submit(_Attempt(*following))
                if self._running:
                    yield from self._finished()
        finally:
            self._cancel()

    def _room(self) -> int:
        """Returns how many shards may be handed out: few enough that they fit into memory."""
        threads = sum(self._connection.threads.values())
        return max(1, threads * (1 + self._settings.waiting))

    def _submit(self, attempt: _Attempt[engine.ShardT]) -> None:
        if not self._connection.threads:
            self._connection.wait()
        others = set(self._connection.threads) - attempt.avoid
        workers = None
        if attempt.avoid and others:
            workers = sorted(others)
        self._submitted += 1
        future = self._connection.client.submit(
            work_on,
            self._work,
            attempt.shard,
            installed_code(),
            key=f"{self._name}-{attempt.number}-{self._submitted}",
            workers=workers,
            pure=False,
        )
        self._running[future] = attempt
        future.add_done_callback(self._done.put)

    def _finished(self) -> Generator[tuple[int, engine.ResultT], None, None]:
        """Yields what is finished; waits for a moment if nothing is."""
        try:
            future = self._done.get(timeout=_POLL_S)
        except queue.Empty:
            if not self._connection.look():
                self._connection.wait()
            return
        attempt = self._running.pop(future, None)
        if attempt is None:
            return
        if future.status == "finished":
            from distributed import CancelledError

            try:
                answer = future.result(timeout=self._settings.patience)
            except (CancelledError, TimeoutError, OSError):
                self._again(attempt, "its result was lost")
                return
            self._report(answer.units)
            yield attempt.number, answer.result
            return
        self._unfinished(future, attempt)

    def _unfinished(self, future: Any, attempt: _Attempt[engine.ShardT]) -> None:
        """Hands out a shard again if its worker is to blame.

        Raises:
            EngineError: it was handed out often enough.
            Exception: what `work` raised.
        """
        if future.status != "error":
            self._connection.wait()
            self._again(attempt, "the connection to the scheduler was lost")
            return
        from distributed import KilledWorker

        error = future.exception()
        if isinstance(error, WorkerTrouble):
            attempt.avoid |= {error.worker}
            self._again(attempt, str(error))
        elif isinstance(error, KilledWorker):
            self._again(attempt, "its workers were killed, perhaps because memory ran out")
        elif "deserializ" in str(error) or isinstance(error, ModuleNotFoundError):
            cause = error.__cause__ or error
            raise EngineError(
                f"a worker cannot read what it is to do ({type(cause).__name__}: {cause}); install"
                " the same cfx and the same plugins on all workers, and start them again"
            ) from error
        else:
            future.result()

    def _again(self, attempt: _Attempt[engine.ShardT], why: str) -> None:
        attempt.tries += 1
        if attempt.tries > self._settings.retries:
            raise EngineError(
                f"shard {attempt.number} was given up after {attempt.tries} tries ({why}); give"
                " workers more memory (engine.memory), lower simulator.memory_mb, or raise"
                " engine.retries; what was finished is kept"
            )
        log.warning("Shard %d is done again: %s", attempt.number, why)
        self._connection.look()
        self._submit(attempt)

    def _cancel(self) -> None:
        """Takes back what is not finished."""
        left = list(self._running)
        self._running = {}
        client = self._connection.client
        if left and client is not None and client.status == "running":
            # The job has its own error to say; that the cluster is gone too adds nothing.
            with suppress(OSError, RuntimeError, TimeoutError):
                client.cancel(left, force=True)
