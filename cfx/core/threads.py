"""Shares work among threads, and sets how many of them PyTorch uses.

Threads of ours sleep while they have nothing to do. PyTorch's own spin, which slows down whatever
else wants the core. PyTorch is imported where it is needed: engines are made before it.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

__all__ = [
    "cores",
    "limit_cores",
    "one_thread",
    "own_cores",
]
"""What plugins may use, as `cfx.plugin.threads`."""


log = logging.getLogger(__name__)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_LIMIT: list[int] = []
_OWN: list[int] = []
"""Cores of a process that has others beside it, such as the workers of a cluster."""


def limit_cores(count: int | None) -> None:
    """Bounds the cores that this process shares work among; None: all that it has."""
    _LIMIT[:] = [] if count is None else [count]


def cores_limit() -> int | None:
    """Returns what `limit_cores` was last called with."""
    return _LIMIT[0] if _LIMIT else None


def own_cores(count: int) -> None:
    """Says how many of the machine's cores this process has, where no job asks for a number."""
    _OWN[:] = [count]


@contextmanager
def one_core() -> Iterator[None]:
    """Shares no work in the block: other processes use the other cores."""
    before = list(_LIMIT)
    _LIMIT[:] = [1]
    try:
        yield
    finally:
        _LIMIT[:] = before


def cores() -> int:
    """Returns how many cores this process shares work among."""
    if hasattr(os, "sched_getaffinity"):
        available = len(os.sched_getaffinity(0))
    else:
        available = os.cpu_count() or 1
    return min([available, *(_LIMIT or _OWN)])


def set_threads(count: int) -> None:
    """Sets how many threads PyTorch uses: no more than this process has cores, with a warning."""
    import torch

    available = cores()
    if count > available:
        log.warning(
            "threads=%d: there are %d cores here, and more threads than cores only wait for one"
            " another; %d are used",
            count,
            available,
            available,
        )
    torch.set_num_threads(min(count, available))


def share(work: Callable[[_Item], _Result], items: Sequence[_Item], *, level: str) -> list[_Result]:
    """Does independent work in threads, one for each core.

    Args:
        work: holds Python's lock for a small part of its time only.
        items: one call of `work` for each.
        level: work that waits for other shared work names another level than that does.

    Returns:
        The results in the order of the items. The first exception is raised again.
    """
    threads = min(cores(), len(items))
    if threads <= 1:
        return [work(item) for item in items]
    return list(_pool(level, threads).map(work, items))


@functools.cache
def _pool(level: str, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cfx-{level}")


# A forked process has none of its parent's threads, and would wait for them forever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


@contextmanager
def one_thread() -> Iterator[None]:
    """Runs the block on one thread.

    Recurrent networks and closed loops take thousands of tiny steps, one after the other: waking a
    second thread for each costs more than it brings, and thirty times more where another program
    wants the same core.
    """
    import torch

    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
