"""A driving model that takes over from a vehicle's measured acceleration.

    a(t) = (1 - m(t)) h(t) + m(t) a_model(t) + sqrt(m(t)) r(t)
    m(t) = 1 - exp(-((t - t0) / tau_m)^2)
    h(t + dt) = h(t) + j(t + dt) dt                         h(t0) = a_measured(t0)
    j(t + dt) = j(t) exp(-dt / tau_j)                       j(t0) = jerk_measured(t0)
    r(t + dt) = c + (r(t) - c) exp(-dt / tau)               r(t0) = 0

A simulation starts with the vehicle's acceleration h, which changes with the jerk at the start; the
jerk decays with the time constant tau_j. The model's share m rises from 0 to 1 with the time
constant tau_m. The residual r, in m/s2, goes from 0 to the target c with the time constant tau. Its
variance is weighted by m, because the acceleration is known at first.

The usual form adds the model's error at the start: `a_model(t) + r(t)` with
`r(t0) = a_measured(t0) - a_model(t0)`. It has the vehicle's acceleration in the first step alone:
afterwards the model's own changes are added. A stiff model, such as Krauss's, reaches its desired
speed within a step, so its error at the start does not predict that of the next step.

Target and time constants are parameters like the model's own: constants make a baseline,
and a policy may choose them anew for each window. The jerk is a parameter too, which is read in the
first step only; 0 where it is unknown. With c drawn at random the residual is
the auto-regressive noise of C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent
driver model*, IEEE T-ITS 25(8), whose errors of acceleration are AR(1).

It never prevents a vehicle from braking hard enough to avoid its leader: see `WithResidual`.

Shapes: `*batch` are any leading dimensions; m is the width of the inner model's memory.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.core.errors import ConfigError
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.regimes import Temperature, safe_sqrt

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
    "the jerk with which the acceleration goes on at the start",
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

HANDOVER = Parameter(
    "residual_handover",
    "s",
    0.2,
    20.0,
    2.0,
    "time constant with which the model takes over from the acceleration at the start",
    "on reconstructed I-80 it forecasts the next two seconds best",
)

RESIDUAL = (TIME, TARGET, JERK, JERK_TIME, HANDOVER)
"""The parameters of a residual, in order."""

_WIDTH = 4
_HELD, _JERK, _RESIDUAL, _PASSED = range(-_WIDTH, 0)
"""Columns of the memory, behind the inner model's."""

_NEAR_M = 0.5
"""m: room to brake in counts as this at least."""

_TIGHT_M = 1.0
"""m: gap below which no residual makes a vehicle faster than its leader. It is not wider: drivers
in congestion follow closely."""

_HARD = 2.0
"""m/s2: from this needed deceleration on, the residual lessens no braking that is needed."""


class WithResidual(DrivingModel):
    """Any driving model, which takes over from the acceleration at the start, and a residual.

    Parameters are the model's, then those of `RESIDUAL`. Memory `(*batch, m + 4)` is the model's,
    the acceleration that is held (m/s2), its jerk (m/s3), the residual (m/s2), and the time since
    the start (s).

    Neither the acceleration at the start nor a residual keeps a vehicle from braking. Where the gap
    is below 1 m and does not grow, the vehicle accelerates no more than the model wants; and where
    a deceleration of more than 2 m/s2 is needed to reach the leader's speed within the gap,
    b = (v - v_l)^2 / (2 s), it brakes at least as hard as that, or as hard as the model wants if
    that is less.

    Args:
        model: the inner model.

    Raises:
        ConfigError: the model has equations in a simulator only.
    """

    parameters = ParameterSpace(RESIDUAL)
    reference = "any model, which takes over from the acceleration at the start"

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
        self.memory_size = model.memory_size + _WIDTH
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
        wanted = self.inner.next_speed(self._inner(follower), leader, p, dt)
        alone = (wanted - follower.speed) / dt
        share = -torch.expm1(-(follower.memory[..., _PASSED] / p[HANDOVER.name]).square())
        held = self._remembered(follower, _HELD, follower.acceleration)
        both = (1.0 - share) * held + share * alone
        both = both + safe_sqrt(share) * follower.memory[..., _RESIDUAL]
        braked = _braked(both, alone, follower, leader)
        return (follower.speed + dt * braked).clamp(min=0.0)

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        jerk = self._remembered(follower, _JERK, p[JERK.name]) * torch.exp(-dt / p[JERK_TIME.name])
        held = self._remembered(follower, _HELD, follower.acceleration) + jerk * dt
        target = p[TARGET.name]
        kept = torch.exp(-dt / p[TIME.name])
        residual = target + (follower.memory[..., _RESIDUAL] - target) * kept
        passed = follower.memory[..., _PASSED] + dt
        inner = self.inner.next_memory(self._inner(follower), leader, p, dt, speed)
        own = torch.stack([held, jerk, residual, passed], -1)
        return torch.cat([inner, own], -1)

    def initial_memory(self, speed: Tensor) -> Tensor:
        own = torch.zeros((*speed.shape, _WIDTH), dtype=speed.dtype, device=speed.device)
        return torch.cat([self.inner.initial_memory(speed), own], -1)

    def _inner(self, follower: Follower) -> Follower:
        """Returns the follower as the inner model knows it."""
        return follower._replace(memory=follower.memory[..., : self.inner.memory_size])

    def _remembered(self, follower: Follower, column: int, at_start: Tensor) -> Tensor:
        """Returns what a column of the memory holds, `(*batch,)`, or this in the first step."""
        has_begun = follower.memory[..., _PASSED] > 0
        return torch.where(has_begun, follower.memory[..., column], at_start)


def with_residual(space: ParameterSpace) -> ParameterSpace:
    """Returns a model's parameters with those of the residual behind them."""
    return replace(space, parameters=(*space, *RESIDUAL))


def _braked(both: Tensor, alone: Tensor, follower: Follower, leader: Leader) -> Tensor:
    """Returns the acceleration `(*batch,)`, m/s2, with all braking that is needed.

    Args:
        both: of the model and the residual.
        alone: that the model wants.
        follower, leader: where they are.
    """
    no_more = torch.minimum(both, alone)
    gap = bumper_gap(follower, leader)
    difference = follower.speed - leader.speed
    closing = difference.clamp(min=0.0)
    needed = closing.square() / (2.0 * gap.clamp(min=_NEAR_M))
    most = torch.maximum(alone, -needed)
    bounded = torch.where(needed > _HARD, torch.minimum(both, most), both)
    return torch.where((gap < _TIGHT_M) & (difference >= 0.0), no_more, bounded)
