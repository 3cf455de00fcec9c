"""Python's collector of cycles, kept from looking through modules while they are imported.

It looks through all objects again and again while their number grows: a fifth of the time of a
short job. What modules bring stays anyway.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

_PROGRAM: list[bool] = []


def is_program() -> None:
    """Says that this process runs cfx alone: all that it holds so far is cfx's own."""
    _PROGRAM[:] = [True]


def runs_program() -> bool:
    """Says whether this process runs cfx alone."""
    return bool(_PROGRAM)


@contextmanager
def importing() -> Iterator[None]:
    """Collects nothing in the block, and looks at nothing again that lives at its end.

    Elsewhere than in cfx's own program it changes nothing: objects of somebody else must be
    collected.
    """
    if not _PROGRAM or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
