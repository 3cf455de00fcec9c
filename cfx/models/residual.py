"""A driving model with a residual: the model explains most of the acceleration, not all of it.

    a(t) = a_model(t) + r(t)        r(t0) = a_measured(t0) - a_model(t0)
    r(t + dt) = c + (r(t) - c) exp(-dt / tau) + j(t + dt) dt        j(t0) = jerk_measured(t0)
    j(t + dt) = j(t) exp(-dt / tau_j)

The residual r begins as what the model misses of the acceleration at the first step. So a
simulation starts with the acceleration that the vehicle has. From there r goes to the target c, in
m/s2, with the time constant tau. Beside that it goes on growing with the jerk that the vehicle has
at the start, which is forgotten with the time constant tau_j: people's accelerations change
smoothly. Target and time constants are parameters like the model's own: constants make a baseline,
and a policy may choose them anew for each window. The jerk is a parameter too, which is read in the
first step only; 0 where nobody knows it. With c drawn at random the residual is
the auto-regressive noise of C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent
driver model*, IEEE T-ITS 25(8), whose errors of acceleration are AR(1).

Where a vehicle has to brake hard so as not to hit its leader, the residual does not keep it from
that: see `WithResidual`.

Shapes: `*batch` are any leading dimensions; m is the width of the inner model's memory.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from cfx.component import content_key, folder_hash
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.regimes import Temperature
from cfx.parameters import Parameter, ParameterSpace

TIME = Parameter(
    "residual_time",
    "s",
    0.2,
    20.0,
    2.0,
    "time constant with which the residual acceleration goes to its target",
    "two seconds: what one driver's errors of IDM take to decorrelate",
)
TARGET = Parameter(
    "residual_target",
    "m/s2",
    -3.0,
    3.0,
    0.0,
    "where the residual acceleration goes",
    "0: the model alone",
)
JERK = Parameter(
    "residual_jerk",
    "m/s3",
    -5.0,
    5.0,
    0.0,
    "the jerk with which the residual acceleration grows at the start",
    "0: it is not known",
)
JERK_TIME = Parameter(
    "residual_jerk_time",
    "s",
    0.01,
    2.0,
    0.8,
    "time constant with which that jerk is forgotten",
    "on reconstructed I-80 it forecasts the next two seconds best",
)

RESIDUAL = (TIME, TARGET, JERK, JERK_TIME)
"""The parameters of a residual, in order."""

_NEAR_M = 0.5
"""m: room to brake in counts as this at least."""

_TIGHT_M = 1.0
"""m: gap below which no residual makes a vehicle faster than its leader. It is not wider: drivers
in congestion follow closely."""

_HARD = 2.0
"""m/s2: from this needed deceleration on, the residual lessens no braking that is needed."""


class WithResidual(DrivingModel):
    """Any driving model, and a residual acceleration beside it.

    Parameters are the model's, then those of `RESIDUAL`. Memory `(*batch, m + 3)`
    is the model's, the residual (m/s2), its jerk (m/s3), and whether it has begun (0 or 1).

    A positive residual could keep a vehicle from braking. So it counts for nothing where the gap is
    below 1 m and does not grow; and where a deceleration of more than 2 m/s2 is needed to reach the
    leader's speed within the gap, b = (v - v_l)^2 / (2 s), the vehicle brakes at least as hard as
    that, or as hard as the model wants if that is less.

    Args:
        model: the inner model.

    Raises:
        ConfigError: the model has equations in a simulator only.
    """

    parameters = ParameterSpace(RESIDUAL)
    reference = "a residual that relaxes exponentially, beside any model"

    def __init__(self, model: DrivingModel) -> None:
        if model.needs_simulator:
            raise ConfigError(
                f"{type(model).__name__} has equations in {model.needs_simulator} only, so no"
                " residual can be added to its acceleration; choose a model that cfx has, such as"
                " krauss or idm"
            )
        self.inner = model
        self.settings = model.settings
        self.space = with_residual(model.space)
        self.memory_size = model.memory_size + 3
        self.temperature = model.temperature

    @property
    def adaptation_space(self) -> ParameterSpace:
        return with_residual(self.inner.adaptation_space)

    def identity(self) -> dict[str, Any]:
        return {"residual": folder_hash(__file__), "model": self.inner.identity()}

    def equations_key(self) -> str:
        return content_key(self.inner.identity())

    def at_temperature(self, temperature: Temperature) -> Self:
        model = copy.copy(self)
        model.temperature = temperature
        model.inner = self.inner.at_temperature(temperature)
        return model

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        alone = self._alone(follower, leader, p, dt)
        residual = self._residual(follower, alone)
        return (follower.speed + dt * _braked(alone, residual, follower, leader)).clamp(min=0.0)

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        residual = self._residual(follower, self._alone(follower, leader, p, dt))
        kept = torch.exp(-dt / p[TIME.name])
        jerk = self._jerk(follower, p) * torch.exp(-dt / p[JERK_TIME.name])
        after = p[TARGET.name] + (residual - p[TARGET.name]) * kept + jerk * dt
        inner = self.inner.next_memory(self._inner(follower), leader, p, dt, speed)
        begun = torch.ones_like(after)
        return torch.cat([inner, torch.stack([after, jerk.expand_as(after), begun], -1)], -1)

    def initial_memory(self, speed: Tensor) -> Tensor:
        own = torch.zeros((*speed.shape, 3), dtype=speed.dtype, device=speed.device)
        return torch.cat([self.inner.initial_memory(speed), own], -1)

    def _inner(self, follower: Follower) -> Follower:
        """Returns the follower as the inner model knows it."""
        return follower._replace(memory=follower.memory[..., : self.inner.memory_size])

    def _alone(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        """Returns the acceleration that the inner model wants, `(*batch,)`, m/s2."""
        wanted = self.inner.next_speed(self._inner(follower), leader, p, dt)
        return (wanted - follower.speed) / dt

    def _residual(self, follower: Follower, alone: Tensor) -> Tensor:
        """Returns the residual now, `(*batch,)`, m/s2: as remembered, or measured at the start."""
        remembered, begun = follower.memory[..., -3], follower.memory[..., -1]
        return torch.where(begun > 0.5, remembered, follower.acceleration - alone)

    def _jerk(self, follower: Follower, p: Mapping[str, Tensor]) -> Tensor:
        """As `_residual`, of its jerk, m/s3."""
        remembered, begun = follower.memory[..., -2], follower.memory[..., -1]
        return torch.where(begun > 0.5, remembered, p[JERK.name])


def with_residual(space: ParameterSpace) -> ParameterSpace:
    """Returns a model's parameters with those of the residual behind them."""
    return replace(space, parameters=(*space, *RESIDUAL))


def _braked(alone: Tensor, residual: Tensor, follower: Follower, leader: Leader) -> Tensor:
    """Returns the acceleration `(*batch,)`, m/s2, with all braking that is needed."""
    both = alone + residual
    no_more = torch.minimum(both, alone)
    gap = bumper_gap(follower, leader)
    difference = follower.speed - leader.speed
    closing = difference.clamp(min=0.0)
    needed = closing.square() / (2.0 * gap.clamp(min=_NEAR_M))
    most = torch.maximum(alone, -needed)
    bounded = torch.where(needed > _HARD, torch.minimum(both, most), both)
    return torch.where((gap < _TIGHT_M) & (difference >= 0.0), no_more, bounded)
