"""Worker processes of a sweep: they end with the process that started them."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator

_AT_WORK = threading.Lock()
_WATCHED: set[int] = set()
_WATCH_S = 1.0


@contextlib.contextmanager
def worker_of(process: int) -> Iterator[None]:
    """Runs a job; a worker whose sweep is killed ends when the job does: joblib's would wait for ever for the next.

    Args:
        process: the one that runs the sweep.
    """
    if os.getpid() != process == os.getppid() and process not in _WATCHED:
        _WATCHED.add(process)
        threading.Thread(target=_end_with, args=(process,), daemon=True).start()
    elif process in _WATCHED and os.getppid() != process:
        os._exit(1)  # a job that was handed over already is the next start's
    with _AT_WORK:
        yield


def _end_with(process: int) -> None:
    while os.getppid() == process:
        time.sleep(_WATCH_S)
    with _AT_WORK:
        os._exit(1)
