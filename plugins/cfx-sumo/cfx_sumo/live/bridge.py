"""What libsumo knows of many vehicles in one compiled call.

Each of libsumo's Python calls looks one value of one vehicle up. A few lines of C++ (`bridge.cpp`)
call the same functions of libsumo for all vehicles, one after the other; the C++ compiler of the
machine builds them once. Where there is none, or libsumo has other functions, Python calls.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfx.plugin import build_library

_TEXT = "RKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"
"""A constant reference to a string in the names of C++ functions."""

_LEADER = f"_ZN7libsumo7Vehicle9getLeaderE{_TEXT}d"
_GETTERS = tuple(
    f"_ZN7libsumo7Vehicle{len(name)}{name}E{_TEXT}"
    for name in ("getSpeed", "getAcceleration", "getMinGap", "getAllowedSpeed")
)
_SETTER = f"_ZN7libsumo7Vehicle8setSpeedE{_TEXT}d"

_ROOM = 256
"""Bytes for the name of a leader who is not among the vehicles that are read, on average."""


class Read(NamedTuple):
    """What SUMO says of D vehicles.

    Attributes:
        rows: place of each vehicle's leader among them, `(D,)` int64; -1: it is another vehicle;
            -2: there is none.
        others: names of those other leaders, in order.
        motions: their speeds and accelerations, `(others, 2)`, SI units.
        values: gap to the leader without `minGap`, speed, acceleration, `minGap` and allowed
            speed, `(D, 5)`, SI units.
    """

    rows: NDArray[np.int64]
    others: list[str]
    motions: NDArray[np.float64]
    values: NDArray[np.float64]


class Bridge:
    """Calls libsumo's functions of vehicles for many at once.

    Args:
        compiled: of `bridge.cpp`.
        libsumo: the library that the Python module `libsumo` is.

    Raises:
        AttributeError: libsumo has other functions.
    """

    def __init__(self, compiled: ctypes.CDLL, libsumo: ctypes.CDLL) -> None:
        self._compiled = compiled
        self._leader = _address(libsumo, _LEADER)
        addresses = [_address(libsumo, name) for name in _GETTERS]
        self._getters = (ctypes.c_void_p * len(addresses))(*addresses)
        self._setter = _address(libsumo, _SETTER)
        self._rows = np.empty(0, dtype=np.int64)
        self._others = np.empty(0, dtype=np.uint8)
        self._names: Sequence[str] = []
        self._text = b""
        compiled.cfx_read.restype = compiled.cfx_tell.restype = ctypes.c_int64

    def read(self, names: Sequence[str], reach: float) -> Read | None:
        """Reads vehicles and who is ahead of them; None where SUMO does not know one of them.

        Args:
            names: D vehicles.
            reach: m, within which a leader counts.
        """
        count = len(names)
        values = np.empty((count, 5))
        # Where leaders were at the last read: a hint, which the compiled function checks.
        rows = np.full(count, -2, dtype=np.int64)
        rows[: len(self._rows)] = self._rows[:count]
        motions = np.empty((count, 2))
        if len(self._others) < _ROOM * (count + 1):
            self._others = np.empty(2 * _ROOM * (count + 1), dtype=np.uint8)
        length = self._compiled.cfx_read(
            ctypes.c_void_p(self._leader),
            self._getters,
            ctypes.c_int64(count),
            self._joined(names),
            ctypes.c_double(reach),
            ctypes.c_void_p(values.ctypes.data),
            ctypes.c_void_p(rows.ctypes.data),
            ctypes.c_void_p(self._others.ctypes.data),
            ctypes.c_void_p(motions.ctypes.data),
            ctypes.c_int64(len(self._others)),
        )
        if length < 0:
            return None
        self._rows = rows
        found = self._others[:length].tobytes().decode().split("\0")[:-1]
        return Read(rows, found, motions[: len(found)], values)

    def set_speeds(self, names: Sequence[str], speeds: NDArray[np.float64]) -> int:
        """Tells SUMO the next speeds of vehicles, m/s; returns how many it took."""
        told = np.ascontiguousarray(speeds)
        count: int = self._compiled.cfx_tell(
            ctypes.c_void_p(self._setter),
            ctypes.c_int64(len(names)),
            self._joined(names),
            ctypes.c_void_p(told.ctypes.data),
        )
        return count

    def _joined(self, names: Sequence[str]) -> bytes:
        """Returns names that each end with 0; mostly they are those of the last call."""
        if names is not self._names:
            self._names, self._text = names, "\0".join(names).encode() + b"\0"
        return self._text


def bridge_of(vehicle: Any) -> Bridge | None:
    """Returns the bridge to libsumo; None where there is none, as over TraCI.

    Args:
        vehicle: of the connection.
    """
    if not getattr(vehicle, "__module__", "").startswith("libsumo"):
        return None
    return _built()


@functools.cache
def _built() -> Bridge | None:
    if not hasattr(os, "RTLD_NOLOAD"):  # on Windows
        return None
    found: Any = importlib.import_module("libsumo._libsumo")
    try:
        libsumo = ctypes.CDLL(found.__file__, mode=os.RTLD_NOLOAD)
        compiled = build_library(Path(__file__).with_suffix(".cpp").read_text(encoding="utf-8"))
        return None if compiled is None else Bridge(compiled, libsumo)
    except (AttributeError, OSError):
        return None


def _address(library: ctypes.CDLL, name: str) -> int:
    address = ctypes.cast(library[name], ctypes.c_void_p).value
    assert address is not None
    return address

