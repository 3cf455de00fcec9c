"""The stochastic head: the residual acceleration is auto-regressive noise around where it goes.

People do not repeat themselves. So the network says, beside all that the residual head says, how
much the acceleration varies: `residual_scale`, the standard deviation s of the residual. In each
window the target of the residual is drawn,

    c' = c + s sqrt((1 + k) / (1 - k)) z,    z ~ N(0, 1),    k = exp(-W / tau)

with windows of W seconds. The residual then is an AR(1) process from window to window, with the
correlation k and, if nothing changes, the standard deviation s around c. That is the error model of
C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent driver model*, IEEE T-ITS
25(8), with a scale and a time constant that depend on the state.

Differences from the source: noise is drawn for each window and goes to its target within it, so
that the acceleration has no jumps; a network, not a posterior, says how much of it there is.

Without a generator nothing is drawn, and the path of the centre is driven.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model, n = m + 6.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.agents.heads.residual import ResidualHead
from cfx.models.base import DrivingModel
from cfx.models.residual import RESIDUAL, TARGET, TIME, WithResidual
from cfx.parameters import Parameter, ParameterSpace

SCALE = Parameter(
    "residual_scale",
    "m/s2",
    0.001,
    2.0,
    0.2,
    "standard deviation of the residual acceleration",
    "Zhang and Sun (2024) find about 0.2 for drivers of highD",
)


class StochasticHead(ResidualHead):
    """As the residual head, with a scale of noise."""

    name: ClassVar[str] = "stochastic"
    noise_width: ClassVar[int] = 1

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        space = WithResidual(model).adaptation_space
        return cls(replace(space, parameters=(*space, SCALE)), device)

    @property
    def model_space(self) -> ParameterSpace:
        return replace(self.space, parameters=self.space.parameters[: -len(RESIDUAL) - 1])

    def sampled(self, parameters: Tensor, noise: Tensor, window_s: float) -> Tensor:
        names = self.space.names
        time = parameters[..., names.index(TIME.name)]
        scale = parameters[..., names.index(SCALE.name)]
        kept = torch.exp(-window_s / time)
        step = scale * torch.sqrt((1.0 + kept) / (1.0 - kept)) * noise[..., 0]
        target = names.index(TARGET.name)
        drawn = parameters[..., target] + step
        before, after = parameters[..., :target], parameters[..., target + 1 :]
        return torch.cat([before, drawn[..., None], after], -1)
