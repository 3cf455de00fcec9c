"""The residual head: offsets from base parameters, and a residual acceleration.

The network chooses, beside the model's parameters, how fast the model takes over from the
acceleration at the start (`cfx.models.composed`), how fast its jerk is forgotten, and where the
residual goes. So the policy starts with exactly the acceleration that the driver has and
with their jerk, and what becomes of both depends on the state that the network reads. An untrained
network is the base, which takes over within seconds. The jerk is measured between the last two
frames; what networks answer in its place is not read.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model, n = m + 5.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import ParameterSpace
from cfx.models.base import DrivingModel
from cfx.models.composed import JERK, RESIDUAL, WithResidual
from cfx.policies.features import History
from cfx.policies.heads.offset import OffsetHead


class ResidualHead(OffsetHead):
    """Answers are offsets from each driver's base, and from the defaults of the residual."""

    name: ClassVar[str] = "residual"
    learners: ClassVar[tuple[str, ...]] = ("rollout",)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(WithResidual(model).adaptation_space, device)

    @property
    def model_space(self) -> ParameterSpace:
        return replace(self.space, parameters=self.space.parameters[: -len(RESIDUAL)])

    def driven_model(self, model: DrivingModel) -> DrivingModel:
        return WithResidual(model)

    def measured(self, parameters: Tensor, history: History, dt: float) -> Tensor:
        return with_measured_jerk(self.space, parameters, history, dt)

    def completed(self, parameters: Tensor) -> Tensor:
        known = parameters.shape[-1]
        if known == len(self.space):
            return parameters
        defaults = self.space.defaults(dtype=parameters.dtype, device=parameters.device)
        more = defaults[known:].expand(*parameters.shape[:-1], -1)
        return torch.cat([parameters, more], -1)


def with_measured_jerk(
    space: ParameterSpace, parameters: Tensor, history: History, dt: float
) -> Tensor:
    """Returns parameters with the jerk that the driver has, between their last two frames.

    Args:
        space: the parameters, with those of a residual among them.
        parameters: `(*batch, n)`, SI units.
        history: the last L frames, `(*batch, L)` each; of one frame nothing is measured.
        dt: time step, s.

    Returns:
        `(*batch, n)`, SI units.
    """
    acceleration = history.follower_acceleration
    if acceleration.shape[-1] < 2:
        return parameters
    jerk = (acceleration[..., -1] - acceleration[..., -2]) / dt
    at = space.names.index(JERK.name)
    bounded = jerk.clamp(JERK.low, JERK.high)[..., None].to(parameters)
    return torch.cat([parameters[..., :at], bounded, parameters[..., at + 1 :]], -1)
