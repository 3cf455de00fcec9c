"""How many threads PyTorch uses for work of many small steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Runs the block on one thread.

    Recurrent networks and closed loops take thousands of tiny steps, one after the other: waking a
    second thread for each costs more than it brings, and thirty times more where another program
    wants the same core.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
