"""SUMO processes that are started once and answer requests until their job ends."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cfx
from cfx.errors import SumoError
from cfx.simulators.sumo.channel import Message, receive, send
from cfx.simulators.sumo.installed import require_sumo
from cfx.simulators.sumo.network import ROAD
from cfx.simulators.sumo.worker import LOG

_PATIENCE_S = 5.0
"""How long a process may take to end when it was asked to."""


class Session:
    """Answers requests in SUMO; `cfx.simulators.sumo.worker` says what they hold.

    Processes start with the first request. They end, and their folders go, with `close`, when
    nobody holds the session any more, and when this process ends, however that happens.

    Args:
        workers: processes at most.

    Raises:
        SumoError: SUMO is not installed, or another version.
    """

    def __init__(self, workers: int) -> None:
        require_sumo()
        self._workers = workers
        self._idle: queue.LifoQueue[_Worker] = queue.LifoQueue()
        self._started: list[_Worker] = []
        weakref.finalize(self, _close, self._started)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def answer(self, requests: Iterable[Message]) -> list[Message]:
        """Answers all requests, in their order; which process answers which makes no difference.

        Raises:
            SumoError: SUMO refuses a request, a vehicle is lost, or a process ended; the session is
                closed then.
        """
        todo = list(requests)
        for _ in range(min(self._workers, len(todo)) - len(self._started)):
            worker = _Worker()
            self._started.append(worker)
            self._idle.put(worker)
        if not todo:
            return []
        try:
            if len(self._started) == 1:
                return [self._started[0].answer(request) for request in todo]
            pool = ThreadPoolExecutor(len(self._started))  # a thread waits for each process
            try:
                return list(pool.map(self._answer, todo))
            finally:
                pool.shutdown(cancel_futures=True)
        except BaseException:
            self.close()  # an answer may be on its way that nobody will read
            raise

    def close(self) -> None:
        """Ends the processes; the next `answer` starts new ones."""
        _close(self._started)
        self._idle = queue.LifoQueue()

    @property
    def processes(self) -> tuple[int, ...]:
        """Ids of the processes that run."""
        return tuple(worker.pid for worker in self._started)

    def _answer(self, request: Message) -> Message:
        worker = self._idle.get()
        try:
            return worker.answer(request)
        finally:
            self._idle.put(worker)


def _close(workers: list[_Worker]) -> None:
    while workers:
        workers.pop().close()


class _Worker:
    """One SUMO process and its folder."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="cfx-sumo-", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(  # noqa: S603 - this Python, a module of ours, a folder of ours
            [sys.executable, "-m", "cfx.simulators.sumo.worker", self._folder.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": _search_path(), "OMP_NUM_THREADS": "1"},
        )

    @property
    def pid(self) -> int:
        return self._process.pid

    def answer(self, request: Message) -> Message:
        process = self._process
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("a process that was started with pipes has them")
        try:
            send(process.stdin, request.header, request.arrays)
            found = receive(process.stdout)
        except OSError:
            found = None
        if found is None:
            raise SumoError(
                f"a SUMO process ended by itself ({self._end()}); run again: what was calibrated so"
                " far is cached"
            )
        if "error" in found.header:
            raise SumoError(_in_words(found.header["error"], self._log()))
        return found

    def close(self) -> None:
        process = self._process
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._folder.cleanup()

    def _end(self) -> str:
        """Says how the process ended."""
        try:
            code = self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            return "it no longer answers"
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        last = ""
        for line in self._log().splitlines():
            if line.strip() and not line.startswith("Warning"):
                last = line.strip()
        return f"{how}: {last}" if last else how

    def _log(self) -> str:
        with contextlib.suppress(OSError):
            return Path(self._folder.name, LOG).read_text(encoding="utf-8", errors="replace")
        return ""


def _in_words(error: str, log: str) -> str:
    """Joins the error that libsumo raised and what SUMO printed beside it.

    Only the two together say what is wrong.
    """
    first = error.strip().rstrip(".")
    if "is not known" in error:
        return (
            f"SUMO lost a vehicle ({first}): it left the {ROAD / 1000:.0f} km of its road; look for"
            " positions far out in the data, and for bounds of parameters that mean nothing"
        )
    said = [first]
    for line in log.splitlines():
        text = line.removeprefix("Error:").strip().rstrip(".")
        if line.startswith("Error:") and text not in said[1:]:
            said.append(text)
    return f"SUMO refuses the vehicles: {': '.join(said)}"


def _search_path() -> str:
    """Returns PYTHONPATH with the folder of this cfx ahead, wherever it was imported from."""
    here = str(Path(cfx.__file__).resolve().parent.parent)
    given = os.environ.get("PYTHONPATH", "")
    return f"{here}{os.pathsep}{given}" if given else here
