"""Arrays that would fill the memory lie in a file, of which the system reads what is needed.

The files have no name, lie where temporary files do (`TMPDIR`) and go with the arrays. What was
read or written stays in memory as long as the system has room for it, and counts as this process's
own until `release`.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cfx.core.errors import OutputError
from cfx.core.memory import in_units

LARGE = 1 << 28
"""Bytes from which on arrays lie in a file."""

_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def empty(shape: tuple[int, ...], dtype: DTypeLike = np.float64, together: int = 1) -> NDArray[Any]:
    """Returns an array with any content.

    Args:
        shape: of the array.
        dtype: of the array.
        together: arrays of this size that are needed at once; they count together.

    Raises:
        OutputError: the disk is full.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size * together < LARGE:
        return np.empty(shape, dtype)
    return in_file(shape, dtype)


def in_file(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Returns an array in a file of its own, with any content.

    Raises:
        OutputError: the disk is full.
    """
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
