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
_LANE = f"_ZN7libsumo7Vehicle9getLaneIDE{_TEXT}"
_SETTER = f"_ZN7libsumo7Vehicle8setSpeedE{_TEXT}d"

_SIGNALS = 7
"""Of a vehicle that are read."""

_ROOM = 256
"""Bytes for a word of a vehicle, such as its lane, on average."""


class Read(NamedTuple):
    """What SUMO says of D vehicles.

    Attributes:
        at: place of the next vehicle ahead of each among them, `(D,)` int64; -1: it is another
            vehicle; -2: there is none.
        others: those other vehicles, in order.
        follows: which of them have a leader, bool `(D,)`.
        signals: what they and their leaders do, `(7, D)`, in the order of `Seen`.
        unchanged: whether `at` and `follows` are those of the reading before.
    """

    at: NDArray[np.int64]
    others: list[str]
    follows: NDArray[np.bool_]
    signals: NDArray[np.float64]
    unchanged: bool = False


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
        self._lane = _address(libsumo, _LANE)
        self._setter = _address(libsumo, _SETTER)
        self._text_room = np.empty(0, dtype=np.uint8)
        self._names: Sequence[str] = []
        self._text = b""
        for function in (compiled.cfx_read, compiled.cfx_words, compiled.cfx_tell):
            function.restype = ctypes.c_int64

    def read(
        self, names: Sequence[str], reach: float, free_road: float, before: Read | None = None
    ) -> Read | None:
        """Reads vehicles and who is ahead of them; None where SUMO does not know one of them.

        Args:
            names: D vehicles.
            reach: m, within which a leader counts.
            free_road: m: the gap of vehicles without a leader.
            before: of an instant ago, of as many vehicles; where leaders were then is looked first.
        """
        count = len(names)
        signals = np.empty((_SIGNALS, count))
        if before is None or len(before.at) != count:
            at, follows = np.full(count, -2, dtype=np.int64), np.zeros(count, dtype=np.bool_)
        else:
            at, follows = before.at.copy(), before.follows.copy()
        text = self._room_for(count)
        changes = ctypes.c_int64(0)
        length = self._compiled.cfx_read(
            ctypes.c_void_p(self._leader),
            self._getters,
            ctypes.c_int64(count),
            self._joined(names),
            ctypes.c_double(reach),
            ctypes.c_double(free_road),
            ctypes.c_void_p(signals.ctypes.data),
            ctypes.c_void_p(at.ctypes.data),
            ctypes.c_void_p(follows.ctypes.data),
            ctypes.c_void_p(text.ctypes.data),
            ctypes.c_int64(len(text)),
            ctypes.byref(changes),
        )
        if length < 0:
            return None
        others = _words(text[:length])
        return Read(at, others, follows, signals, before is not None and changes.value == 0)

    def lanes(self, names: Sequence[str]) -> list[str] | None:
        """Returns the lane of each vehicle; None where SUMO does not know one of them."""
        text = self._room_for(len(names))
        length = self._compiled.cfx_words(
            ctypes.c_void_p(self._lane),
            ctypes.c_int64(len(names)),
            self._joined(names),
            ctypes.c_void_p(text.ctypes.data),
            ctypes.c_int64(len(text)),
        )
        return None if length < 0 else _words(text[:length])

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

    def _room_for(self, count: int) -> NDArray[np.uint8]:
        """Returns room for a word of each of so many vehicles, which is used again."""
        if len(self._text_room) < _ROOM * (count + 1):
            self._text_room = np.empty(2 * _ROOM * (count + 1), dtype=np.uint8)
        return self._text_room

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
    module: Any = importlib.import_module("libsumo._libsumo")
    try:
        libsumo = ctypes.CDLL(module.__file__, mode=os.RTLD_NOLOAD)
        compiled = build_library(Path(__file__).with_suffix(".cpp").read_text(encoding="utf-8"))
        return None if compiled is None else Bridge(compiled, libsumo)
    except (AttributeError, OSError):
        return None


def _address(library: ctypes.CDLL, name: str) -> int:
    address = ctypes.cast(library[name], ctypes.c_void_p).value
    assert address is not None
    return address


def _words(text: NDArray[np.uint8]) -> list[str]:
    """Returns the words of a text, each of which ends with 0."""
    if len(text) == 0:
        return []
    return text.tobytes().decode().split("\0")[:-1]
