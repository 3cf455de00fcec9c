"""Driving models made of others: with a residual acceleration, two together, with a speed limit.

**With a residual**, a model takes over from a vehicle's measured acceleration:

    a(t) = (1 - m(t)) h(t) + m(t) a_model(t) + sqrt(m(t)) r(t)
    m(t) = 1 - exp(-((t - t0) / tau_m)^2)
    h(t + dt) = h(t) + j(t + dt) dt                         h(t0) = a_measured(t0)
    j(t + dt) = j(t) exp(-dt / tau_j)                       j(t0) = jerk_measured(t0)
    r(t + dt) = c + (r(t) - c) exp(-dt / tau)               r(t0) = 0

A simulation starts with the vehicle's acceleration h, which changes with the jerk at the start; the
jerk decays with the time constant tau_j. The model's share m rises from 0 to 1 with the time
constant tau_m. The residual r, in m/s2, goes from 0 to the target c with the time constant tau. Its
variance is weighted by m, because the acceleration is known at first. Near standstill less of a
negative residual counts (`WithResidual`).

The usual form adds the model's error at the start: `a_model(t) + r(t)` with
`r(t0) = a_measured(t0) - a_model(t0)`. It has the vehicle's acceleration in the first step alone:
afterwards the model's own changes are added. A stiff model, such as Krauss's, reaches its desired
speed within a step, so its error at the start does not predict that of the next step.

Target and time constants are parameters like the model's own: constants make a baseline,
and a policy may choose them anew for each window. The jerk is a parameter too, which is read in the
first step only; 0 where it is unknown. With c drawn at random the residual is
the auto-regressive noise of C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent
driver model*, IEEE T-ITS 25(8), whose errors of acceleration are AR(1).

**Two models together** drive with the weighted mean of their accelerations. Combining forecasts
with such a weight is J. M. Bates and C. W. J. Granger (1969), *The combination of forecasts*, OR
20(4). Where one model's errors say little about the other's, the mean errs less than either.

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
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.regimes import Temperature, safe_sqrt

__all__ = [
    "COMFORTABLE_BRAKING",
    "RELAXATION_TIME",
    "SPEED_LIMIT",
    "WithSpeedLimit",
]
"""What plugins may use, as `cfx.plugin.composed`."""


class Composed(DrivingModel):
    """Base of driving models that have another one inside.

    Limits are the inner model's. Parameters and memory are the inner model's, then its own.

    Args:
        inner: the model inside.
        further: parameters behind the inner model's.
        width: of its own memory.
    """

    parameters = ParameterSpace(())

    def __init__(
        self, inner: DrivingModel, further: tuple[Parameter, ...] = (), width: int = 0
    ) -> None:
        self.inner = inner
        self.settings = inner.settings
        self.further = further
        self.space = replace(inner.space, parameters=(*inner.space, *further))
        self.memory_size = inner.memory_size + width
        self.temperature = inner.temperature

    @property
    def adaptation_space(self) -> ParameterSpace:
        space = self.inner.adaptation_space
        return replace(space, parameters=(*space, *self.further))

    def identity(self) -> dict[str, Any]:
        return {"composed": folder_hash(__file__), "model": self.inner.identity()}

    def equations_key(self) -> str:
        return content_key(self.identity())

    def at_temperature(self, temperature: Temperature) -> Self:
        model = copy.copy(self)
        model.temperature = temperature
        model.inner = self.inner.at_temperature(temperature)
        return model

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        return self.inner.next_memory(self.inside(follower), leader, p, dt, speed)

    def initial_memory(self, speed: Tensor) -> Tensor:
        width = self.memory_size - self.inner.memory_size
        own_memory = torch.zeros((*speed.shape, width), dtype=speed.dtype, device=speed.device)
        return torch.cat([self.inner.initial_memory(speed), own_memory], -1)

    def inside(self, follower: Follower) -> Follower:
        """Returns the follower as the inner model knows it."""
        return follower._replace(memory=follower.memory[..., : self.inner.memory_size])


WEIGHT = Parameter(
    "weight", "1", 0.0, 1.0, 0.5, "share of the first model in the acceleration", "half of each"
)

PREFIX = "second_"
"""Before the names of the second model's parameters."""


class Combined(Composed):
    """Two driving models that share one vehicle.

        v(t + dt) = w v_1(t + dt) + (1 - w) v_2(t + dt)

    v_1 and v_2 are the next speeds that the two want from the same state. The mean of speeds one
    step ahead is that of accelerations. Parameters are the first model's, the second's with the
    prefix `second_`, and `weight`.

    Args:
        first, second: the models.
    """

    reference = "the weighted mean of two models"

    def __init__(self, first: DrivingModel, second: DrivingModel) -> None:
        # The two models may share names of parameters.
        added = []
        for parameter in second.space:
            added.append(replace(parameter, name=f"{PREFIX}{parameter.name}"))
        super().__init__(first, (*added, WEIGHT), second.memory_size)
        self.second = second

    def identity(self) -> dict[str, Any]:
        return {**super().identity(), "second": self.second.identity()}

    def at_temperature(self, temperature: Temperature) -> Self:
        model = super().at_temperature(temperature)
        model.second = self.second.at_temperature(temperature)
        return model

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        proposed = self.inner.next_speed(self.inside(follower), leader, p, dt)
        other = self.second.next_speed(self._beside(follower), leader, of_second(p), dt)
        weight = p[WEIGHT.name]
        return weight * proposed + (1.0 - weight) * other

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        first = super().next_memory(follower, leader, p, dt, speed)
        beside = self._beside(follower)
        return torch.cat(
            [first, self.second.next_memory(beside, leader, of_second(p), dt, speed)], -1
        )

    def initial_memory(self, speed: Tensor) -> Tensor:
        return torch.cat([self.inner.initial_memory(speed), self.second.initial_memory(speed)], -1)

    def _beside(self, follower: Follower) -> Follower:
        """Returns the follower as the second model knows it."""
        return follower._replace(memory=follower.memory[..., self.inner.memory_size :])


def of_second(p: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the second model's parameters under its own names."""
    parameters = {}
    for name, value in p.items():
        if name.startswith(PREFIX):
            parameters[name.removeprefix(PREFIX)] = value
    return parameters


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


RELAXATION_TIME = Parameter(
    "residual_time",
    "s",
    0.2,
    20.0,
    2.0,
    "time constant with which the residual acceleration goes to its target",
    "two seconds: what one driver's errors of IDM take to decorrelate",
)
"""The parameter of `WithResidual` by which its acceleration beside the model's changes, s."""
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

RESIDUAL = (RELAXATION_TIME, TARGET, JERK, JERK_TIME, HANDOVER)
"""The parameters of a residual, in order."""

_WIDTH = 4
_HELD, _JERK, _RESIDUAL, _PASSED = range(-_WIDTH, 0)
"""Columns of the memory, behind the inner model's."""

_NEAR_M = 0.5
"""m: room to brake in counts as this at least."""

_TIGHT_M = 1.0
"""m: gap below which a vehicle accelerates no more than its model wants. It is not wider: drivers
in congestion follow closely. Relative speed does not matter: behind a standing leader whose
measured speed is 0.01 m/s a residual of 0.3 m/s2 in every second step closed the last 10 cm within
20 s, until the gap was negative (four cars with ACC of ZalaZone)."""

_BRAKES_IN_FULL_MPS = 5.0
"""m/s: speed from which a residual brakes in full. Up to it the weight rises with the square of the
speed. On the ring of `cfx drive` cars of cfx://idm-acc then crawl at 1.5 m/s, which is what their
model alone does; at 0.8 m/s with a weight that rises linearly, and at 0.1 m/s without any."""

_HARD = 2.0
"""m/s2: from this needed deceleration on, the residual lessens no braking that is needed."""


class WithResidual(Composed):
    """Any driving model, which takes over from the acceleration at the start, and a residual.

    Parameters are the model's, then those of `RESIDUAL`. Memory `(*batch, m + 4)` is the model's,
    the acceleration that is held (m/s2), its jerk (m/s3), the residual (m/s2), and the time since
    the start (s).

    Neither the acceleration at the start nor a residual keeps a vehicle from braking. Where the gap
    is below 1 m, the vehicle accelerates no more than the model wants, so that a residual brings it
    no closer to its leader than the model does; and where a deceleration of more than 2 m/s2 is
    needed to reach the leader's speed within the gap, b = (v - v_l)^2 / (2 s), it brakes at least
    as hard as that, or as hard as the model wants if that is less.

    Nor does a residual hold a queue that the model lets move. A residual says by how much a moving
    driver's acceleration differs from the model's, and at a standstill there is none to differ. So
    a negative residual counts as

        min(1, v / (5 m/s))^2 r

    and a vehicle moves off as the model alone does. A positive one counts in full: without it
    drivers who follow into a moving queue are too slow (docs/tried.md).

    Args:
        model: the inner model.

    Raises:
        ConfigError: the model has equations in a simulator only.
    """

    reference = "any model, which takes over from the acceleration at the start"

    def __init__(self, model: DrivingModel) -> None:
        if model.needs_simulator:
            raise ConfigError(
                f"{type(model).__name__} has equations in {model.needs_simulator} only, so no"
                " residual can be added to its acceleration; choose a model that cfx has, such as"
                " krauss or idm"
            )
        super().__init__(model, RESIDUAL, _WIDTH)

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        proposed = self.inner.next_speed(self.inside(follower), leader, p, dt)
        alone = (proposed - follower.speed) / dt
        share = -torch.expm1(-(follower.memory[..., _PASSED] / p[HANDOVER.name]).square())
        held_acceleration = self._remembered(follower, _HELD, follower.acceleration)
        mixed = (1.0 - share) * held_acceleration + share * alone
        mixed = mixed + safe_sqrt(share) * _residual_at(follower)
        braked = _braked(mixed, alone, follower, leader)
        return (follower.speed + dt * braked).clamp(min=0.0)

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        jerk = self._remembered(follower, _JERK, p[JERK.name]) * torch.exp(-dt / p[JERK_TIME.name])
        held_acceleration = self._remembered(follower, _HELD, follower.acceleration) + jerk * dt
        target = p[TARGET.name]
        share = torch.exp(-dt / p[RELAXATION_TIME.name])
        residual = target + (follower.memory[..., _RESIDUAL] - target) * share
        passed = follower.memory[..., _PASSED] + dt
        inner = super().next_memory(follower, leader, p, dt, speed)
        own_memory = torch.stack([held_acceleration, jerk, residual, passed], -1)
        return torch.cat([inner, own_memory], -1)

    def _remembered(self, follower: Follower, column: int, at_start: Tensor) -> Tensor:
        """Returns what a column of the memory holds, `(*batch,)`, or this in the first step."""
        has_begun = follower.memory[..., _PASSED] > 0
        return torch.where(has_begun, follower.memory[..., column], at_start)


def with_residual(space: ParameterSpace) -> ParameterSpace:
    """Returns a model's parameters with those of the residual behind them."""
    return replace(space, parameters=(*space, *RESIDUAL))


def _residual_at(follower: Follower) -> Tensor:
    """Returns the residual as far as it counts at the follower's speed, `(*batch,)`, m/s2."""
    residual = follower.memory[..., _RESIDUAL]
    weight = (follower.speed / _BRAKES_IN_FULL_MPS).clamp(max=1.0).square()
    return residual.clamp(min=0.0) + weight * residual.clamp(max=0.0)


def _braked(mixed: Tensor, alone: Tensor, follower: Follower, leader: Leader) -> Tensor:
    """Returns `both`, that of model and residual, with all braking that is needed, m/s2."""
    gap = bumper_gap(follower, leader)
    closing = (follower.speed - leader.speed).clamp(min=0.0)
    needed = closing.square() / (2.0 * gap.clamp(min=_NEAR_M))
    most = torch.maximum(alone, -needed)
    bounded = torch.where(needed > _HARD, torch.minimum(mixed, most), mixed)
    return torch.where(gap < _TIGHT_M, torch.minimum(mixed, alone), bounded)


SPEED_LIMIT = "speed_limit"
"""Name of the limit among the values that the model is given, m/s; infinity: there is none."""

COMFORTABLE_BRAKING = 2.0
"""m/s2: how hard a driver brakes who is faster than the limit."""


class WithSpeedLimit(Composed):
    """Any driving model that has equations, with a speed limit that comes with its parameters.

    Where a driver would be faster than the limit they slow down to it at a comfortable
    deceleration, and react to their leader as without it. The limit is no parameter: it is of the
    road, and changes where a vehicle drives (`LIMIT` in what `next_speed` is given).

    Args:
        model: the inner model.
    """

    reference = "the smaller of the model's speed and of a speed limit"

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        proposed = self.inner.next_speed(follower, leader, p, dt)
        slowed = follower.speed - COMFORTABLE_BRAKING * dt
        return torch.minimum(proposed, torch.maximum(p[SPEED_LIMIT], slowed))
