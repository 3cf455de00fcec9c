"""The residual head: offsets from base parameters, and a residual acceleration that decays.

The network chooses, beside the model's parameters, how fast the residual of
`cfx.models.residual` is forgotten and where it goes. So the policy starts with exactly the
acceleration that the driver has, and its decay depends on the state that the network reads. An
untrained network is the base with a residual that decays in two seconds.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model, n = m + 2.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.agents.heads.offset import OffsetHead
from cfx.models.base import DrivingModel
from cfx.models.residual import RESIDUAL, WithResidual
from cfx.parameters import ParameterSpace


class ResidualHead(OffsetHead):
    """Answers are offsets from each driver's base, and from the defaults of the residual."""

    name: ClassVar[str] = "residual"

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(WithResidual(model).adaptation_space, device)

    @property
    def model_space(self) -> ParameterSpace:
        return replace(self.space, parameters=self.space.parameters[: -len(RESIDUAL)])

    def driven_model(self, model: DrivingModel) -> DrivingModel:
        return WithResidual(model)

    def completed(self, parameters: Tensor) -> Tensor:
        known = parameters.shape[-1]
        if known == len(self.space):
            return parameters
        defaults = self.space.defaults(dtype=parameters.dtype, device=parameters.device)
        more = defaults[known:].expand(*parameters.shape[:-1], -1)
        return torch.cat([parameters, more], -1)
