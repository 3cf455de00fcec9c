"""The direct head with a residual: parameters, which take over from the acceleration at the start.

It is for policies that are not trained. Their networks answer the driving model's parameters; those
of the residual (`cfx.models.composed`) are the defaults, but for the jerk, which is measured.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model, n = m + 5.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import ParameterSpace
from cfx.models.base import DrivingModel
from cfx.models.composed import RESIDUAL, WithResidual, with_residual
from cfx.policies.features import History
from cfx.policies.heads.direct import DirectHead
from cfx.policies.heads.residual import with_measured_jerk


class DirectResidualHead(DirectHead):
    """Answers are parameters in unit space; the residual is the same for all."""

    name: ClassVar[str] = "direct_residual"
    learners: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(with_residual(model.space), device)

    @property
    def model_space(self) -> ParameterSpace:
        return replace(self.space, parameters=self.space.parameters[: -len(RESIDUAL)])

    @property
    def answers(self) -> int:
        return len(self.model_space)

    def driven_model(self, model: DrivingModel) -> DrivingModel:
        return WithResidual(model)

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        return self._with_defaults(answer, self.space.to_unit(self.space.defaults()))

    def measured(self, parameters: Tensor, history: History, dt: float) -> Tensor:
        return with_measured_jerk(self.space, parameters, history, dt)

    def completed(self, parameters: Tensor) -> Tensor:
        return self._with_defaults(parameters, self.space.defaults())

    def _with_defaults(self, values: Tensor, defaults: Tensor) -> Tensor:
        """Returns `(*batch, n)` of `(*batch, m)`, or what is complete already."""
        known = values.shape[-1]
        more = defaults[known:].to(values).expand(*values.shape[:-1], -1)
        return torch.cat([values, more], -1)
