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
        description="m/s2: hardest braking of a live vehicle that nothing endangers",
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
    """Returns the speed that a vehicle can have one step later, nearest to the one wanted.

    With a response time t_a the acceleration follows the wanted one as a first-order lag, exactly
    integrated over a step: `a' = a + (1 - exp(-dt / t_a)) (a_wanted - a)`.

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
        share = -math.expm1(-dt / limits.response_time)
        proposed = speed + dt * acceleration + share * (proposed - speed - dt * acceleration)
    slowest = (speed - limits.emergency_deceleration * dt).clamp(min=0.0)
    fastest = speed + limits.acceleration * dt
    return torch.minimum(torch.maximum(proposed, slowest), fastest)


def at_limits(limits: LimitSettings | None, speed: Tensor, dt: float) -> Tensor:
    """Says at which frames a vehicle is at a limit of acceleration.

    Args:
        limits: of the vehicle; None: there are none.
        speed: `(*batch, K + 1)`, m/s.
        dt: time step, s.

    Returns:
        `(*batch, K + 1)` bool, for the acceleration on the way to each frame; frame 0 has none.
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
