"""Schedulers and workers as processes of their own, on this machine, which tests stop and kill."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.checkout import ROOT


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


class Cluster:
    """A scheduler, and workers with a nanny that starts a killed one again."""

    def __init__(self) -> None:
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler = self.start_scheduler()
        self.workers: list[subprocess.Popen[bytes]] = []

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        where = ["--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        return _start("distributed.cli.dask_scheduler", *where)

    def start_worker(
        self, *options: str, root: Path = ROOT, **environment: str
    ) -> subprocess.Popen[bytes]:
        """Starts a worker that imports cfx from `root`."""
        where = [self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard"]
        worker = _start("distributed.cli.dask_worker", *where, *options, root=root, **environment)
        self.workers.append(worker)
        return worker

    def children(self, worker: subprocess.Popen[bytes]) -> list[int]:
        """Returns the processes that a nanny has started."""
        listed = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text()
        return [int(number) for number in listed.split()]

    @contextmanager
    def kills(self, rounds: int, when: Callable[[], object]) -> Iterator[None]:
        """Kills all workers with signal 9, again and again, beside the block.

        Nannies start them again. The block must not end before the last round.

        Args:
            rounds: how often.
            when: says that it is time for the next round; the work must have made some progress
                since the last one, or it would never end.
        """

        def kill() -> None:
            for _ in range(rounds):
                until(when, seconds=120.0)
                for worker in self.workers:
                    for child in self.children(worker):
                        with suppress(ProcessLookupError):
                            os.kill(child, signal.SIGKILL)

        with meanwhile(kill) as killing:
            yield
            assert not killing.is_alive(), "the work ended before the workers were killed"

    def stop(self) -> None:
        for process in [*self.workers, self.scheduler]:
            _end(process)


def _start(
    module: str, *arguments: str, root: Path = ROOT, **environment: str
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # so that its children can be ended with it
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGCONT)
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(30)


@contextmanager
def running_cluster(workers: int, *options: str) -> Iterator[Cluster]:
    """Yields a cluster that is stopped after the block."""
    cluster = Cluster()
    try:
        for _ in range(workers):
            cluster.start_worker(*options)
        yield cluster
    finally:
        cluster.stop()


@contextmanager
def meanwhile(what: Callable[[], None]) -> Iterator[threading.Thread]:
    """Does something beside the block, and waits for its end after it."""
    thread = threading.Thread(target=what)
    thread.start()
    try:
        yield thread
    finally:
        thread.join()


def until(what: object, seconds: float = 60.0) -> None:
    """Waits until a function returns something true."""
    end = time.monotonic() + seconds
    while not what():  # type: ignore[operator]
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)
