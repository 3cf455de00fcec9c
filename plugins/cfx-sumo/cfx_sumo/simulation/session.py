"""SUMO processes that are started once and answer requests until their job ends."""

from __future__ import annotations

import itertools
import re
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterable
from concurrent.futures import CancelledError
from pathlib import Path

from loky.process_executor import BrokenProcessPool, ShutdownExecutorError

from cfx.errors import SumoError
from cfx.plugin import worker_pool
from cfx_sumo.installed import require_sumo
from cfx_sumo.simulation.worker import LOG, Answer, Request, answer, begin


class Session:
    """Answers requests in SUMO, of any number of threads.

    The processes belong to an executor, which alone gives them calls and takes their results. They
    start with the first request. They end, and their folders go, with `close`, when nobody holds
    the session any more, and when this process ends, however that happens.

    Args:
        workers: how many processes.

    Raises:
        SumoError: SUMO is not installed, or another version.
    """

    def __init__(self, workers: int) -> None:
        require_sumo()
        self._workers = workers
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._pool: _Pool | None = None

    def __reduce__(self) -> tuple[type[Session], tuple[int]]:
        """Returns what another process makes a session of its own from."""
        return Session, (self._workers,)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def answer(self, requests: Iterable[Request]) -> list[Answer]:
        """Answers all requests, in their order; which process answers which makes no difference.

        Raises:
            SumoError: SUMO refuses a request, a vehicle is lost, a process ended, or the session
                was closed meanwhile.
        """
        numbered = list(zip(self._numbers, requests, strict=False))
        if not numbered:
            return []
        with self._lock:
            if self._pool is None:
                self._pool = _Pool(self._workers)
            pool = self._pool
        try:
            return pool.answer(numbered)
        except BrokenProcessPool as error:
            with self._lock:  # threads that wait for the same processes say the same
                pool.end(error)
                if self._pool is pool:
                    self._pool = None
            raise SumoError(
                f"a SUMO process ended by itself ({pool.reason}); run again: what was calibrated so"
                " far is cached"
            ) from error
        except (ShutdownExecutorError, CancelledError) as error:
            raise SumoError("SUMO was ended in the middle of a simulation") from error

    def close(self) -> None:
        """Ends the processes, also within a request; the next `answer` starts new ones."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.end()


class _Pool:
    """An executor and the folder of its processes."""

    reason = ""

    def __init__(self, workers: int) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="cfx-sumo-"))
        self._remove = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._executor = worker_pool(workers, begin, self._folder, folder=self._folder)

    def answer(self, numbered: list[tuple[int, Request]]) -> list[Answer]:
        # None is cancelled where one fails: an executor that is shut down meanwhile would trip over
        # it, and whoever fails shuts it down soon.
        futures = [self._executor.submit(answer, number, request) for number, request in numbered]
        answers = [future.result() for future in futures]
        for (number, _), given in zip(numbered, answers, strict=True):
            if given.number != number:
                raise RuntimeError(f"SUMO's answer {given.number} was given to request {number}")
        return answers

    def end(self, error: BaseException | None = None) -> None:
        """Ends the processes, because of an error perhaps; again, it does nothing."""
        if error is not None and not self.reason:
            self.reason = self._reason(error)
        self._executor.shutdown(wait=True, kill_workers=True)
        self._remove()

    def _reason(self, error: BaseException) -> str:
        """Says how a process ended, and what SUMO printed last."""
        codes = re.search(r"exit codes of the workers are \{(.*)\}", str(error))
        reasons = [codes[1] if codes else str(error).partition(".")[0]]
        for log in self._folder.glob(f"*/{LOG}"):
            text = log.read_text(encoding="utf-8", errors="replace")
            # What follows is a traceback of Python's.
            for line in text.partition("Fatal Python error")[0].splitlines()[-1:]:
                if line.strip() and not line.startswith("Warning"):
                    reasons.append(line.strip())
        return ": ".join(reasons)
