"""Heads with a residual acceleration: the model takes over from the acceleration at the start.

Beside the model's parameters stand those of the residual (`cfx.models.composed`): how fast the
model takes over, how fast the jerk at the start is forgotten, and where the residual goes. So the
policy starts with exactly the acceleration that the driver has and with their jerk. The jerk is
measured between the last two frames; what networks answer in its place is not read.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model, n = m + 5.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import ParameterSpace
from cfx.models.base import DrivingModel
from cfx.models.composed import JERK, RESIDUAL, WithResidual, with_residual
from cfx.policies.heads.base import DirectHead, ParameterHead
from cfx.policies.heads.offset import OffsetHead
from cfx.policies.history import History


class _Residual(ParameterHead):
    """What heads with a residual have in common."""

    @property
    def model_space(self) -> ParameterSpace:
        return replace(self.space, parameters=self.space.parameters[: -len(RESIDUAL)])

    def driven_model(self, model: DrivingModel) -> DrivingModel:
        return WithResidual(model)

    def measured(self, parameters: Tensor, history: History, dt: float) -> Tensor:
        """Fills in the jerk between the last two frames; of one frame nothing is measured."""
        acceleration = history["follower_acceleration"]
        if acceleration.shape[-1] < 2:
            return parameters
        jerk = (acceleration[..., -1] - acceleration[..., -2]) / dt
        at = self.space.names.index(JERK.name)
        bounded = jerk.clamp(JERK.low, JERK.high)[..., None].to(parameters)
        return torch.cat([parameters[..., :at], bounded, parameters[..., at + 1 :]], -1)

    def completed(self, parameters: Tensor) -> Tensor:
        dtype, device = parameters.dtype, parameters.device
        return _with_defaults(parameters, self.space.defaults(dtype=dtype, device=device))


class ResidualHead(_Residual, OffsetHead):
    """Answers are offsets from each driver's base, and from the defaults of the residual.

    What becomes of the acceleration and the jerk at the start depends on the state that the network
    reads. An untrained network is the base, which takes over within seconds.
    """

    name: ClassVar[str] = "residual"
    learners: ClassVar[tuple[str, ...]] = ("rollout",)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(WithResidual(model).adaptation_space, device)


class DirectResidualHead(_Residual, DirectHead):
    """Answers are parameters in unit space; the residual is the same for all.

    It is for policies that are not trained.
    """

    name: ClassVar[str] = "direct_residual"
    learners: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(with_residual(model.space), device)

    @property
    def answers(self) -> int:
        return len(self.model_space)

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        return _with_defaults(answer, self.space.to_unit(self.space.defaults()))


def _with_defaults(values: Tensor, defaults: Tensor) -> Tensor:
    """Returns `(*batch, n)` of `(*batch, m)`, or what is complete already."""
    more = defaults[values.shape[-1] :].to(values).expand(*values.shape[:-1], -1)
    return torch.cat([values, more], -1)
