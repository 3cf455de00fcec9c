"""The stochastic head: auto-regressive noise on the acceleration and on the model's parameters.

People do not repeat themselves, and no two of them are alike. So the network says, beside all that
the residual head says, how much the acceleration varies, and how much each parameter of the driving
model does.

**Acceleration.** `residual_scale` is the standard deviation s of the residual. In each window the
target of the residual is drawn,

    c' = c + s sqrt((1 + k) / (1 - k)) z,    z ~ N(0, 1),    k = exp(-W / tau)

with windows of W seconds. The residual then is an AR(1) process from window to window, with the
correlation k and, if nothing changes, the standard deviation s around c. That is the error model of
C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent driver model*, IEEE T-ITS
25(8), with a scale and a time constant that depend on the state.

Differences from the source: noise is drawn for each window and goes to its target within it, so
that the acceleration has no jumps; a network, not a posterior, says how much of it there is.

**Parameters.** `NAME_scale` is the standard deviation s_i of the parameter NAME in the squashed
space (on logits), and `parameter_time` the time constant tau_p with which a driver's parameters
vary:

    logit(u_i') = logit(u_i) + s_i y_i
    y_i <- k_p y_i + sqrt(1 - k_p^2) z_i,    z_i ~ N(0, 1),    k_p = exp(-W / tau_p)

with u_i what the network says of the parameter in unit space. Drawn are the parameters of the
driving model and `residual_handover`, the time constant with which the model takes over. The first
y_i is z_i itself, so that each y_i is standard normal in every window, whatever the network says. A
sampled driver so is one draw of a continuous mixture over parameters, who changes slowly. No draw
leaves the bounds; frozen parameters have the scale 0. A model that takes its speed within one step,
as Krauss's does, cancels noise on the acceleration in the next; noise on parameters stays. A finite
mixture needs a simulation of each component and has no gradient for its weights, and noise that is
correlated among parameters needs n^2 answers.

Without a generator nothing is drawn, and the path of the centre is driven.

Shapes: `*batch` any leading dimensions, m tuned parameters of the driving model; n = 2 m + 8, k = m
+ 2 random numbers of a window, of which q = m + 1 are kept. With noise on the acceleration alone n
= m + 6, k = 1, q = 0.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models.base import DrivingModel
from cfx.models.composed import HANDOVER, RELAXATION_TIME, RESIDUAL, TARGET, WithResidual
from cfx.policies.heads.offset import step_of
from cfx.policies.heads.residual import ResidualHead

NOISE_SCALE = Parameter(
    "residual_scale",
    "m/s2",
    0.001,
    2.0,
    0.2,
    "standard deviation of the residual acceleration",
    "Zhang and Sun (2024) find about 0.2 for drivers of highD",
)
"""The parameter that scales a sampled driver's noise on the acceleration, m/s2."""
PARAMETER_TIME = Parameter(
    "parameter_time",
    "s",
    0.5,
    30.0,
    5.0,
    "time constant with which a sampled driver's parameters vary",
    "five seconds: a driver stays the same for several",
)


class StochasticHead(ResidualHead):
    """As the residual head, with scales of noise.

    Attributes:
        noise_width: k.
        latent_width: q: what is kept are the y_i.
    """

    name: ClassVar[str] = "stochastic"
    learners: ClassVar[tuple[str, ...]] = ("rollout",)

    def __init__(self, space: ParameterSpace, device: torch.device | str | None = None) -> None:
        super().__init__(space, device)
        drawn = []  # places of parameters that have a scale
        for place, name in enumerate(space.names):
            if _scale_name(name) in space.names:
                drawn.append(place)
        self.latent_width = len(drawn)
        self.noise_width = 1 + self.latent_width
        self._drawn = torch.tensor(drawn, dtype=torch.int64, device=device)
        self._low, self._high = space.bounds(device=device)[:, self._drawn].unbind(0)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        space = WithResidual(model).adaptation_space
        scales = [_scale_of(parameter, 0.3) for parameter in model.adaptation_space.tuned]
        scales.append(_scale_of(HANDOVER, 0.5))
        return cls(
            replace(space, parameters=(*space, NOISE_SCALE, PARAMETER_TIME, *scales)), device
        )

    def of_acceleration(self) -> Self:
        """Returns the head of constant parameters: with noise on the acceleration alone."""
        end = self._names().index(NOISE_SCALE.name) + 1
        space = replace(self.space, parameters=self.space.parameters[:end])
        return type(self)(space, self._low.device)

    @property
    def model_space(self) -> ParameterSpace:
        end = self._names().index(RESIDUAL[0].name)
        return replace(self.space, parameters=self.space.parameters[:end])

    def _names(self) -> list[str]:
        """Returns the names of all parameters, constants of the model among them."""
        return [parameter.name for parameter in self.space]

    def sampled(
        self, parameters: Tensor, noise: Tensor, latent: Tensor, window_s: float
    ) -> tuple[Tensor, Tensor]:
        drawn = self._with_acceleration(parameters, noise[..., 0], window_s)
        if self.latent_width == 0:
            return drawn, latent
        return self._with_parameters(drawn, noise[..., 1:], latent, window_s)

    def _with_acceleration(self, parameters: Tensor, noise: Tensor, window_s: float) -> Tensor:
        """Draws where the residual acceleration goes, from noise `(*batch,)`."""
        names = self.space.names
        time = parameters[..., names.index(RELAXATION_TIME.name)]
        scale = parameters[..., names.index(NOISE_SCALE.name)]
        correlation = torch.exp(-window_s / time)
        step = scale * torch.sqrt((1.0 + correlation) / (1.0 - correlation)) * noise
        target = names.index(TARGET.name)
        drawn = parameters[..., target] + step
        before, after = parameters[..., :target], parameters[..., target + 1 :]
        return torch.cat([before, drawn[..., None], after], -1)

    def _with_parameters(
        self, parameters: Tensor, noise: Tensor, latent: Tensor, window_s: float
    ) -> tuple[Tensor, Tensor]:
        """Draws the parameters that have a scale, from noise `(*batch, q)`."""
        time = self.space.names.index(PARAMETER_TIME.name)
        correlation = torch.exp(-window_s / parameters[..., time, None])
        correlation = torch.where(latent == 0, 0.0, correlation)
        latent = correlation * latent + torch.sqrt(1.0 - correlation.square()) * noise
        scale = parameters[..., -self.latent_width :]
        low, high = self._low.to(parameters), self._high.to(parameters)
        centre = parameters[..., self._drawn]
        step = step_of((centre - low) / (high - low), scale * latent)
        drawn = (centre + step * (high - low)).clamp(low, high)
        return parameters.index_copy(-1, self._drawn, drawn), latent


def _scale_of(parameter: Parameter, default: float) -> Parameter:
    """Returns the scale of a parameter; 0 where it is frozen."""
    if parameter.frozen:
        default = 0.0
    return Parameter(
        _scale_name(parameter.name),
        "1",
        0.0,
        2.0,
        default,
        f"standard deviation of {parameter.name} in the squashed space",
        "on logits: 0.3 are some 7 % of the range in its middle",
        frozen=parameter.frozen,
    )


def _scale_name(name: str) -> str:
    """Returns the name of a parameter's scale."""
    return f"{name}_scale"
