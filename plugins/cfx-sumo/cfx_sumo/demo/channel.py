"""Messages between a job and the SUMO process of its demonstration.

A message is a JSON header and arrays, as `.npz` bytes with their length ahead. Nothing is pickled.
This module imports neither torch nor SUMO: both sides read it.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LENGTH = struct.Struct(">Q")
_HEADER = "header"


class Message(NamedTuple):
    """What one side tells the other.

    Attributes:
        header: what JSON can say.
        arrays: by name.
    """

    header: dict[str, Any]
    arrays: dict[str, Array]


def send(
    stream: IO[bytes], header: Mapping[str, Any], arrays: Mapping[str, Array] | None = None
) -> None:
    """Writes a message.

    Raises:
        OSError: nobody reads the stream any more.
    """
    buffer = io.BytesIO()
    named: dict[str, Any] = {_HEADER: np.array(json.dumps(header)), **(arrays or {})}
    np.savez(buffer, allow_pickle=False, **named)
    data = buffer.getvalue()
    stream.write(_LENGTH.pack(len(data)))
    stream.write(data)
    stream.flush()


def receive(stream: IO[bytes]) -> Message | None:
    """Reads a message; None where the other side is gone."""
    length = stream.read(_LENGTH.size)
    if len(length) < _LENGTH.size:
        return None
    size: int = _LENGTH.unpack(length)[0]
    data = stream.read(size)
    if len(data) < size:
        return None
    with np.load(io.BytesIO(data), allow_pickle=False) as found:
        header: dict[str, Any] = json.loads(str(found[_HEADER][()]))
        arrays = {name: found[name] for name in found.files if name != _HEADER}
        return Message(header, arrays)
