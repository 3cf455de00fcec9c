"""Keeps freed memory in the process, so that the next arrays need no fresh pages.

A calibration writes arrays of a few megabytes, frees them and asks for them again. By its own
rule glibc gives such memory back to the system each time, which must then clear and map fresh
pages: a tenth of the time of a calibration of labels, and half of it with larger arrays.
"""

from __future__ import annotations

import ctypes
import functools

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
