"""Speeds that a running SUMO simulation is told to drive next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx_sumo.live.bridge import bridge_of
from cfx_sumo.live.surroundings import Connection

_TOGETHER = 500
"""Commands in one message over TraCI."""


def set_speeds(connection: Connection, names: Sequence[str], speeds: NDArray[np.float64]) -> None:
    """Tells SUMO the next speeds of D vehicles, m/s.

    In libsumo that is one compiled call. Over TraCI each command is a message that waits for its
    answer, 25 µs; but a message may hold any number of commands, so many are put into one.
    """
    tell, bridge, told = connection.vehicle.setSpeed, bridge_of(connection.vehicle), 0
    if bridge is not None:
        told = bridge.set_speeds(names, speeds)
    for first in range(told, len(names), _TOGETHER):
        with _one_message(connection.vehicle):
            for name, speed in zip(
                names[first : first + _TOGETHER],
                speeds[first : first + _TOGETHER].tolist(),
                strict=True,
            ):
                tell(name, speed)


@contextmanager
def _one_message(domain: Any) -> Iterator[None]:
    """Sends the commands of the block together, where the connection is TraCI's."""
    link: Any = getattr(domain, "_connection", None)
    send = getattr(link, "_sendExact", None)
    if send is None:  # libsumo, or a TraCI of another make: each command goes by itself
        yield
        return
    link._sendExact = lambda: None  # noqa: SLF001 - commands add up until it is called
    try:
        yield
    finally:
        del link._sendExact  # noqa: SLF001 - the class's own is back
        if link._queue:  # noqa: SLF001
            send()
