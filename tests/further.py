"""Further signals of tests, inputs that read them, and pairs that have them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from torch import Tensor

from cfx.core import registry
from cfx.data.pairs import PairSet
from cfx.data.signals import Signal
from cfx.policies.history import History
from cfx.policies.inputs.base import PolicyInput

RAIN = Signal("rain", "mm/h", "rainfall", "rain_mmph", low=0, high=200)
SECOND_GAP = Signal(
    "second_leader_gap",
    "m",
    "to the second vehicle ahead, bumper to bumper",
    "second_leader_gap_m",
    "gap",
)
SECOND_SPEED = Signal(
    "second_leader_speed",
    "m/s",
    "speed of the second vehicle ahead",
    "second_leader_speed_mps",
    "speed",
    low=0,
)


class Rain(PolicyInput):
    """How much it rains."""

    unit = "mm/h"
    meaning = "rainfall"
    signals = (RAIN,)

    def values(self, history: History) -> Tensor:
        return history["rain"]


class SecondLeader(PolicyInput):
    """How far ahead the second leader is, in time."""

    unit = "s"
    meaning = "gap to the second vehicle ahead, over its speed"
    signals = (SECOND_GAP, SECOND_SPEED)

    def values(self, history: History) -> Tensor:
        return history["second_leader_gap"] / history["second_leader_speed"].clamp(min=1.0)


INPUTS = {"rain": Rain, "second_leader": SecondLeader}


@contextmanager
def known_inputs() -> Iterator[None]:
    """Makes the inputs known to this process, as if a distribution brought them."""
    for name, cls in INPUTS.items():
        registry.add("input", name, cls)
    try:
        yield
    finally:
        for name in INPUTS:
            registry._of_this_process.pop(("input", name))


def with_surroundings(pairs: PairSet) -> PairSet:
    """Returns pairs in changing rain, behind a second leader 30 m ahead of the first."""
    changed = []
    for number, pair in enumerate(pairs):
        frames = np.arange(len(pair))
        surroundings = {
            RAIN: 5.0 + number + 4.0 * np.sin(frames / 20),
            SECOND_GAP: pair.gap + 30.0,
            SECOND_SPEED: pair.leader_speed + 0.5 * np.sin(frames / 15),
        }
        changed.append(replace(pair, surroundings=surroundings))
    return replace(pairs, pairs=tuple(changed))
