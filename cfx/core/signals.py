"""SIGTERM as an exception, so that whatever runs ends as it does after Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

from cfx.core.errors import Terminated


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Turns SIGTERM into `Terminated`."""

    def terminate(_number: int, _frame: FrameType | None) -> None:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, terminate)
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def ignore_signals() -> None:
    """Ignores Ctrl-C and SIGTERM from now on: what was to be done is done, or said."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
