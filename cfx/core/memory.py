"""This machine's memory: whether work fits into it, and arrays in files where they do not.

The files of arrays have no name, lie where temporary files do (`TMPDIR`) and go with the arrays.
What was read or written stays in memory as long as the system has room for it, and counts as this
process's own until `release`.
"""

from __future__ import annotations

import ctypes
import functools
import math
import mmap
import os
import sys
import tempfile
import weakref
from typing import TYPE_CHECKING, Any

import psutil  # type: ignore[import-untyped]  # it ships no types

from cfx.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray

LARGE = 1 << 28
"""Bytes from which on arrays lie in a file."""

_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

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
"""How much freed memory glibc keeps; larger blocks than the second it asks the system for alone."""


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


def empty(shape: tuple[int, ...], dtype: DTypeLike = float, together: int = 1) -> NDArray[Any]:
    """Returns an array with any content, in a file if it is large.

    Args:
        shape, dtype: of the array.
        together: arrays of this size that are needed at once; they count together.

    Raises:
        OutputError: the disk is full.
    """
    import numpy as np

    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size * together < LARGE:
        return np.empty(shape, dtype)
    return in_file(shape, dtype)


def in_file(shape: tuple[int, ...], dtype: DTypeLike = float) -> NDArray[Any]:
    """Returns an array in a file of its own, with any content.

    Raises:
        OutputError: the disk is full.
    """
    import numpy as np

    size = max(1, math.prod(shape) * np.dtype(dtype).itemsize)
    try:
        with tempfile.TemporaryFile(prefix="cfx-") as file:
            _reserve(file.fileno(), size)
            content = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise OutputError(
            f"{tempfile.gettempdir()}: has no room for {in_units(size)} of temporary data"
            f" ({error.strerror or error}); set TMPDIR to a folder on a disk that has"
        ) from error
    _maps.add(content)
    count = math.prod(shape)
    return np.frombuffer(content, dtype, count).reshape(shape)


def release() -> None:
    """Takes what was read and written out of this process's memory; nothing is lost."""
    advice = getattr(mmap, "MADV_DONTNEED", None)  # where there is none, the system decides
    if advice is None:
        return
    for content in list(_maps):
        content.madvise(advice)


def _reserve(file: int, size: int) -> None:
    """Gives a file its size; a disk that is full says so now, not when the array is written."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.truncate(file, size)
