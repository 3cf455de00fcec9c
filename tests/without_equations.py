"""A model that only a simulator of its own drives, for what refuses such models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NoReturn

from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader


class WithoutEquations(DrivingModel):
    """Stands for a model whose equations are in SUMO."""

    parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap", "made up"))
    differentiable = False
    needs_simulator = "sumo"

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> NoReturn:
        raise ConfigError("it has no equations in Python; add simulator=sumo")
