"""The guard: limits of acceleration that hold for every vehicle, whatever the model wants.

Shapes: `*batch` are any leading dimensions.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import Tensor

from cfx.core.component import Settings

Values = TypeVar("Values", Tensor, NDArray[Any])
"""A tensor or an array."""

_AT = 1e-6
"""m/s2: an acceleration this close to a limit counts as being at it."""


class LimitSettings(Settings):
    """Limits of a vehicle's acceleration; the defaults are those of SUMO's passenger car."""

    acceleration: float = Field(2.6, gt=0, le=50, description="m/s2: largest acceleration")
    comfortable_deceleration: float = Field(
        4.5,
        gt=0,
        le=50,
        description="m/s2: hardest braking in live driving, unless a collision threatens",
    )
    emergency_deceleration: float = Field(
        9.0, gt=0, le=50, description="m/s2: hardest braking at all"
    )
    response_time: float | None = Field(
        None,
        gt=0,
        le=10,
        description="s: time constant with which the acceleration follows the model's; null: at"
        " once",
    )

    @model_validator(mode="after")
    def _in_order(self) -> LimitSettings:
        if self.comfortable_deceleration > self.emergency_deceleration:
            raise ValueError(
                f"comfortable_deceleration={self.comfortable_deceleration:g} exceeds"
                f" emergency_deceleration={self.emergency_deceleration:g}; lower the first"
            )
        return self


def limited_speed(
    limits: LimitSettings | None, speed: Tensor, acceleration: Tensor, proposed: Tensor, dt: float
) -> Tensor:
    """Returns the speed one step later: the model's, as far as the limits allow it.

    With a response time t_a the acceleration follows the model's with a first-order lag. Its
    differential equation `da/dt = (a_model - a) / t_a` is solved exactly over the step, in which
    a_model is constant: `a' = a + (1 - exp(-dt / t_a)) (a_model - a)`.

    Args:
        limits: of the vehicle; None: there are none.
        speed: now, `(*batch,)`, m/s.
        acceleration: the last realised one, `(*batch,)`, m/s2.
        proposed: the model's next speed, `(*batch,)`, m/s.
        dt: time step, s.

    Returns:
        `(*batch,)`, m/s, not negative.
    """
    if limits is None:
        return proposed
    if limits.response_time is not None:
        # The equation above times dt, plus v: v + dt a' = (v + dt a) + share (proposed - v - dt a).
        share = -math.expm1(-dt / limits.response_time)
        proposed = speed + dt * acceleration + share * (proposed - speed - dt * acceleration)
    slowest = (speed - limits.emergency_deceleration * dt).clamp(min=0.0)
    fastest = speed + limits.acceleration * dt
    return torch.minimum(torch.maximum(proposed, slowest), fastest)


def at_limits(limits: LimitSettings | None, speed: Tensor, dt: float) -> Tensor:
    """Says at which frames a vehicle accelerates or brakes as hard as its limits allow.

    Args:
        limits: of the vehicle; None: there are none.
        speed: `(*batch, K + 1)`, m/s.
        dt: time step, s.

    Returns:
        `(*batch, K + 1)` bool. Frame k is judged by the acceleration from frame k - 1 to k; frame 0
        is False.
    """
    frames = torch.zeros_like(speed, dtype=torch.bool)
    if limits is None:
        return frames
    frames[..., 1:] = is_at_limit(limits, speed.diff(dim=-1) / dt)
    return frames


def is_at_limit(limits: LimitSettings, acceleration: Values) -> Values:
    """Says which accelerations `(*batch,)`, m/s2, are at a limit, bool `(*batch,)`."""
    return (acceleration >= limits.acceleration - _AT) | (
        acceleration <= -limits.emergency_deceleration + _AT
    )
