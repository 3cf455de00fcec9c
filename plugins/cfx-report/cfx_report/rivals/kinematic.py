"""Drivers who learn nothing: what a method has to beat at all."""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.plugin import PairSet
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver


class _Keeps(StepDriver):
    """Keeps the acceleration that a follower has at first, times a factor."""

    every = 1_000_000  # the first acceleration holds to the end

    def __init__(self, factor: float) -> None:
        self._factor = factor

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        return self._factor * seen.follower_acceleration[:, -1], memory


class ConstantSpeed(Rival):
    """Drives on at the speed of the last measured frame."""

    reference = "kinematics"

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        return _Keeps(0.0)


class ConstantAcceleration(Rival):
    """Drives on with the acceleration of the last measured frame, and stands once it stops."""

    reference = "kinematics"

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        return _Keeps(1.0)
