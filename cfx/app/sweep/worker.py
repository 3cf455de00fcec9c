"""Worker processes of a sweep: they end with the process that started them."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator

_AT_WORK = threading.Lock()
"""Held while this process runs a job."""

_WATCHED: set[int] = set()
"""Processes of sweeps whose end this worker watches for."""

_WATCH_S = 1.0
"""Seconds between two looks."""


@contextlib.contextmanager
def worker_of(process: int) -> Iterator[None]:
    """Runs a job; a worker whose sweep was killed ends when its job does.

    joblib's workers would wait for the next job for ever.

    Args:
        process: the one that runs the sweep.
    """
    is_its_worker = os.getpid() != process and os.getppid() == process
    if is_its_worker and process not in _WATCHED:
        _WATCHED.add(process)
        threading.Thread(target=_end_with, args=(process,), daemon=True).start()
    elif process in _WATCHED and os.getppid() != process:
        os._exit(1)  # the next start of the sweep runs a job that was handed over already
    with _AT_WORK:
        yield


def _end_with(process: int) -> None:
    while os.getppid() == process:
        time.sleep(_WATCH_S)
    with _AT_WORK:
        os._exit(1)
