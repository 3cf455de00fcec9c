"""Checks, before anything is allocated, whether it fits into this machine's memory."""

from __future__ import annotations

import ctypes
import functools
import sys

import psutil  # type: ignore[import-untyped]  # it ships no types

from cfx.core.errors import ConfigError

_UNITS = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")


def require_memory(needed: float, what: str) -> None:
    """Checks that this machine has as much memory.

    Args:
        needed: an estimate, bytes.
        what: the setting that asks for it, as a user writes it.

    Raises:
        ConfigError: it has less, whatever else runs.
    """
    available = total_memory()
    if needed > available:
        raise ConfigError(
            f"{what} needs about {in_units(needed)} of memory, and this machine has"
            f" {in_units(available)}; lower it"
        )


def total_memory() -> float:
    """Returns this machine's memory, bytes."""
    return float(psutil.virtual_memory().total)


def give_back() -> None:
    """Returns this process's free memory to the system, such as that of a file just read.

    Arrow keeps it otherwise, and so does glibc.
    """
    arrow = sys.modules.get("pyarrow")
    if arrow is not None:
        arrow.default_memory_pool().release_unused()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def is_out_of_memory(error: BaseException) -> bool:
    """Says whether an error is that memory ran out; PyTorch says so in words."""
    return isinstance(error, MemoryError) or "allocate memory" in str(error)


def in_units(size: float) -> str:
    """Returns a number of bytes for people: 3.1 TB."""
    place = 0
    while size >= 1000 and place < len(_UNITS) - 1:
        size /= 1000
        place += 1
    return f"{size:.3g} {_UNITS[place]}"


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # from glibc's malloc.h
_TRIM_BYTES, _MMAP_BYTES = 64 << 20, 32 << 20


@functools.cache
def keep_freed_memory() -> bool:
    """Makes glibc keep up to 64 MB of freed memory; returns whether this is glibc.

    The values are the highest that glibc itself would come to; it only starts from lower ones.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES) and mallopt(_M_TRIM_THRESHOLD, _TRIM_BYTES))
