"""SIGTERM as an exception, so that whatever runs ends as it does after Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

from cfx.core.errors import Terminated


class _Terminate:
    """A handler of SIGTERM that remembers what it raised."""

    def __init__(self) -> None:
        self.raised: Terminated | None = None

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.raised = Terminated()
        raise self.raised


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Turns SIGTERM into `Terminated`."""
    if isinstance(signal.getsignal(signal.SIGTERM), _Terminate):
        yield
        return
    try:
        before = signal.signal(signal.SIGTERM, _Terminate())
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def raise_if_terminated() -> None:
    """Raises again what SIGTERM raised in code that went on or failed otherwise.

    OmegaConf and C code that imports a module do so.

    Raises:
        Terminated: SIGTERM arrived in a block of `terminable`.
    """
    handler = signal.getsignal(signal.SIGTERM)
    if isinstance(handler, _Terminate) and handler.raised is not None:
        raise handler.raised


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
    """Ignores Ctrl-C and SIGTERM from now on, at the end of the program."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
