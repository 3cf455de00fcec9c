"""Signals that code swallows are raised again; what handled them before does so afterwards."""

from __future__ import annotations

import contextlib
import signal

import pytest

from cfx.core.processes import raise_if_signalled, terminable
from cfx.errors import Terminated


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_signal_that_code_swallowed_is_raised_again(
    number: signal.Signals, kind: type[BaseException]
) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with terminable():
            raise_if_signalled()  # nothing has arrived
            with contextlib.suppress(kind), terminable():
                signal.raise_signal(number)
            with pytest.raises(kind):
                raise_if_signalled()
        raise_if_signalled()  # outside it is nobody's
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with terminable():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
