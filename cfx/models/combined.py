"""A vehicle that two models drive: its acceleration is the weighted mean of theirs.

    v(t + dt) = w v_1(t + dt) + (1 - w) v_2(t + dt)

v_1 and v_2 are the next speeds that the two models want from the same state. The mean of speeds one
step ahead is that of accelerations.

Combining forecasts with such a weight is J. M. Bates and C. W. J. Granger (1969), *The combination
of forecasts*, OR 20(4). Where one model's errors say little about the other's, the mean errs less
than either.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.regimes import Temperature

WEIGHT = Parameter(
    "weight", "1", 0.0, 1.0, 0.5, "share of the first model in the acceleration", "half of each"
)

PREFIX = "second_"
"""Before the names of the second model's parameters."""


class Combined(DrivingModel):
    """Two driving models that share one vehicle.

    Parameters are the first model's, the second's with the prefix `second_`, and `weight`. Memory
    is the first model's, then the second's. Limits are the first model's.

    Args:
        first, second: the models.
    """

    parameters = ParameterSpace((WEIGHT,))
    reference = "the weighted mean of two models"

    def __init__(self, first: DrivingModel, second: DrivingModel) -> None:
        self.first = first
        self.second = second
        self.settings = first.settings
        renamed = tuple(replace(one, name=f"{PREFIX}{one.name}") for one in second.space)
        self.space = replace(first.space, parameters=(*first.space, *renamed, WEIGHT))
        self.memory_size = first.memory_size + second.memory_size
        self.temperature = first.temperature

    @property
    def adaptation_space(self) -> ParameterSpace:
        return self.space

    def identity(self) -> dict[str, Any]:
        models = {"first": self.first.identity(), "second": self.second.identity()}
        return {"combined": folder_hash(__file__), **models}

    def equations_key(self) -> str:
        return content_key(self.identity())

    def at_temperature(self, temperature: Temperature) -> Self:
        model = copy.copy(self)
        model.temperature = temperature
        model.first = self.first.at_temperature(temperature)
        model.second = self.second.at_temperature(temperature)
        return model

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        first, second = self._followers(follower)
        wanted = self.first.next_speed(first, leader, p, dt)
        other = self.second.next_speed(second, leader, of_second(p), dt)
        weight = p[WEIGHT.name]
        return weight * wanted + (1.0 - weight) * other

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        first, second = self._followers(follower)
        return torch.cat(
            [
                self.first.next_memory(first, leader, p, dt, speed),
                self.second.next_memory(second, leader, of_second(p), dt, speed),
            ],
            -1,
        )

    def initial_memory(self, speed: Tensor) -> Tensor:
        return torch.cat([self.first.initial_memory(speed), self.second.initial_memory(speed)], -1)

    def _followers(self, follower: Follower) -> tuple[Follower, Follower]:
        """Returns the follower as each model knows it."""
        width = self.first.memory_size
        return (
            follower._replace(memory=follower.memory[..., :width]),
            follower._replace(memory=follower.memory[..., width:]),
        )


def of_second(p: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the second model's parameters under its own names."""
    return {
        name.removeprefix(PREFIX): value for name, value in p.items() if name.startswith(PREFIX)
    }


def for_both(
    first: Mapping[str, Tensor], second: Mapping[str, Tensor], weight: Tensor
) -> dict[str, Tensor]:
    """Returns the parameters of a combined model.

    Args:
        first, second: of each model, by name.
        weight: share of the first, `(*batch,)`.
    """
    renamed = {f"{PREFIX}{name}": value for name, value in second.items()}
    return {**first, **renamed, WEIGHT.name: weight}
