"""The connection to a cluster: made when it is needed, and made again when it is lost."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from cfx.errors import EngineError
from cfx_dask.engine import clusters
from cfx_dask.engine.settings import DaskSettings

log = logging.getLogger(__name__)

_LOOK_S = 0.5
"""Seconds between two looks for a scheduler or a worker."""

_SAY_S = 60.0
"""Seconds between two messages that workers are still waited for."""

_SETTINGS = {
    # For its developers Dask keeps the last 1,000 messages to each worker, and a shard is one.
    "distributed.admin.low-level-log-length": 1,
    "distributed.admin.large-graph-warning-threshold": "4GB",
    # Nobody looks at what workers are doing every hundredth of a second.
    "distributed.worker.profile.enabled": False,
}
"""Settings of Dask while the connection lasts."""

_UNREACHABLE = (OSError, TimeoutError, RuntimeError, AttributeError)
"""What Dask raises, at one place or another, when the scheduler is gone."""


class Connection:
    """A cluster and a client of it.

    Args:
        settings: of the engine.
    """

    def __init__(self, settings: DaskSettings) -> None:
        self._settings = settings
        self._cluster: Any = None
        self._client: Any = None
        self._threads: dict[str, int] = {}
        self._quiet = ExitStack()

    @property
    def client(self) -> Any:
        """The client, connected; `wait` has made it."""
        return self._client

    @property
    def threads(self) -> dict[str, int]:
        """Threads of each worker by its address, when `wait` or `look` looked last."""
        return self._threads

    def wait(self) -> None:
        """Waits until there is a scheduler and a worker.

        Raises:
            EngineError: there is none, although the patience is over.
        """
        began = said = time.monotonic()
        while not self.look():
            now = time.monotonic()
            patience = self._settings.patience
            if patience is not None and now - began > patience:
                raise EngineError(self._complaint(now - began))
            if now - said > _SAY_S:
                said = now
                log.info("Still waiting for workers, since %.0f s", now - began)
            time.sleep(_LOOK_S)

    def look(self) -> bool:
        """Says whether there are workers now; connects if there is no connection."""
        self._threads = {}
        with suppress(*_UNREACHABLE):
            self._connect()
            if self._client.status == "running":
                self._threads = dict(self._client.nthreads())
        return bool(self._threads)

    def close(self) -> None:
        """Lets go of the client and of a cluster of the job's own."""
        client, cluster = self._client, self._cluster
        self._client = self._cluster = None
        self._threads = {}
        for held in (client, cluster):
            if held is not None:
                # What is closed may be gone already.
                with suppress(*_UNREACHABLE):
                    held.close()
        self._quiet.close()

    def _connect(self) -> None:
        if self._client is not None and self._client.status in {"running", "connecting"}:
            return
        from distributed import Client

        if self._client is None:
            import dask

            self._quiet.enter_context(_quiet())
            self._quiet.enter_context(dask.config.set(_SETTINGS))
        target: Any = self._settings.address
        if target is None:
            if self._cluster is None:
                self._cluster = clusters.start(self._settings)
            target = self._cluster
        self._client = Client(target, timeout="5s", set_as_default=False)

    def _complaint(self, waited: float) -> str:
        kept = "what was finished is kept, so run again when they are there"
        if self._settings.address is None:
            return (
                f"engine.cluster={self._settings.cluster or 'local'}: no worker has come for"
                f" {waited:.0f} s; {kept}, or set engine.patience_s higher"
            )
        if self._client is not None and self._client.status == "running":
            return (
                f"engine.address={self._settings.address}: the scheduler has had no worker for"
                f" {waited:.0f} s; start some with: dask worker {self._settings.address}; {kept}"
            )
        return (
            f"engine.address={self._settings.address}: no scheduler has answered for"
            f" {waited:.0f} s; start one with: dask scheduler --host 127.0.0.1; {kept}"
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps Dask's own messages out of a job's: it says in a sentence of its own what is wrong."""
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
