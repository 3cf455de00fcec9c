"""SIGTERM as an exception, so that whatever runs ends as it does after Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

from cfx.core.errors import Terminated


@contextlib.contextmanager
def terminable() -> Iterator[list[BaseException]]:
    """Turns SIGTERM into `Terminated`.

    Yields:
        What was raised so far: code that a signal hits, such as C code that imports a module, may
        raise an error of its own instead, without a context.
    """
    raised: list[BaseException] = []

    def terminate(_number: int, _frame: FrameType | None) -> None:
        raised.append(Terminated())
        raise raised[-1]

    try:
        before = signal.signal(signal.SIGTERM, terminate)
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield raised
        return
    try:
        yield raised
    finally:
        signal.signal(signal.SIGTERM, before)


def signal_behind(error: BaseException) -> BaseException | None:
    """Returns the Ctrl-C or SIGTERM that an error comes from.

    Lightning answers Ctrl-C with sys.exit, and a library that a signal hits while it is imported or
    tidies up may raise an error of its own.
    """
    current: BaseException | None = error
    while current is not None:
        if isinstance(current, KeyboardInterrupt | Terminated):
            return current
        current = current.__context__
    return None


def ignore_signals() -> None:
    """Ignores Ctrl-C and SIGTERM from now on: what was to be done is done, or said."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
