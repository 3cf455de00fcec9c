"""A driving model on a road with speed limits.

Where a driver would be faster than the limit they keep to it: they slow down to it at a comfortable
deceleration, and react to their leader as without it.

Shapes: `*batch` are any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.core.parameters import ParameterSpace
from cfx.models.base import DrivingModel, Follower, Leader

LIMIT = "speed_limit"
"""Name of the limit among the values that the model is given, m/s; infinity: there is none."""

COMFORTABLE = 2.0
"""m/s2: how hard a driver brakes who is faster than the limit."""


class WithSpeedLimit(DrivingModel):
    """Any driving model that has equations, with a speed limit that comes with its parameters.

    Parameters and memory are the model's. The limit is no parameter: it is of the road, and changes
    where a vehicle drives (`LIMIT` in what `next_speed` is given).

    Args:
        model: the inner model.
    """

    parameters = ParameterSpace(())
    reference = "the smaller of the model's speed and of a speed limit"

    def __init__(self, model: DrivingModel) -> None:
        self.inner = model
        self.settings = model.settings
        self.space = model.space
        self.memory_size = model.memory_size
        self.temperature = model.temperature

    @property
    def adaptation_space(self) -> ParameterSpace:
        return self.inner.adaptation_space

    def identity(self) -> dict[str, Any]:
        return {"speed_limit": folder_hash(__file__), "model": self.inner.identity()}

    def equations_key(self) -> str:
        return content_key(self.inner.identity())

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        wanted = self.inner.next_speed(follower, leader, p, dt)
        slowed = follower.speed - COMFORTABLE * dt
        return torch.minimum(wanted, torch.maximum(p[LIMIT], slowed))

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        return self.inner.next_memory(follower, leader, p, dt, speed)

    def initial_memory(self, speed: Tensor) -> Tensor:
        return self.inner.initial_memory(speed)
