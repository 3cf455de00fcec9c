"""Gipps's model with its reaction time as a delay (`gipps_delay`).

P. G. Gipps (1981), *A behavioural car-following model for computer simulation*, Transportation
Research Part B 15(2), 105-111; as a delay equation: R. E. Wilson (2001), *An analysis of Gipps's
car-following model of highway traffic*, IMA Journal of Applied Mathematics 66(5), 509-537.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import DrivingModel, Follower, Leader, ModelSettings, ParameterSpace, Settings
from cfx_community.models.delay import frames_seen, memory_width, perceive, recall, remember
from cfx_community.models.gipps import GIPPS_PARAMETERS, intended_speed


class GippsDelaySettings(ModelSettings):
    """Settings of Gipps's model with a delay."""

    max_delay_s: float = Field(
        2.0, gt=0.0, description="longest reaction time that can be simulated, s: tau's upper bound"
    )
    shortest_step_s: float = Field(
        0.1,
        gt=0.0,
        description="shortest time step of the data, s; max_delay_s / shortest_step_s frames are"
        " remembered",
    )


def _parameters() -> ParameterSpace:
    """Returns Gipps's parameters, with reaction times up to 2 s: memory costs time."""
    tau, *others = GIPPS_PARAMETERS
    return ParameterSpace.of(dataclasses.replace(tau, high=2.0), *others)


class GippsDelay(DrivingModel):
    """Reaches, one reaction time after each instant, the speed that Gipps's driver chose in it.

    With G the smaller one of v_free and v_safe of `gipps`, a function of gap and speeds,

        v(t + tau) = max(0, G(g(t), v(t), v_l(t)))       for every t

    A step of dt < tau takes g, v and v_l at t + dt - tau from the model's memory, which holds the
    last frames; between two frames they are interpolated linearly. Nothing is known of the time
    before the first frame. So, as in the paper, the speed changes linearly over the first tau, from
    the first frame's to the one that the driver chose in it.

    At equilibrium (v = v_l < V) the gap is `s0 + 1.5 v tau + v^2 (1 / b - 1 / b_hat) / 2`, that of
    `gipps`. With dt >= tau nothing is delayed, and the model is `gipps`.

    Differences from the paper: the paper's driver decides every tau, here they decide in every
    frame (Wilson 2001). Every sequence of speeds that lie tau apart obeys the paper's equation.
    Positions are the simulation's Euler sums, the paper's are trapezoidal.

    Differences from SUMO: SUMO has no Gipps model. SUMO's `actionStepLength` lets a driver decide
    less often; it does not delay what they see.
    """

    schema: ClassVar[type[Settings]] = GippsDelaySettings
    settings: GippsDelaySettings
    reference = "Gipps (1981), Transp. Res. B 15(2); Wilson (2001), IMA J. Appl. Math. 66(5)"
    collision_free = True
    search_effort = 2.0
    parameters = _parameters()

    def __init__(self, settings: Settings | None = None, **options: object) -> None:
        super().__init__(settings, **options)
        longest = self.settings.max_delay_s
        high = max(self.space["tau"].high, self.adaptation_space["tau"].high)
        if high > longest:
            raise ConfigError(
                f"model.max_delay_s={longest:g} is less than tau's upper bound of {high:g} s;"
                f" write model.max_delay_s={high:g}, or lower the bound"
            )
        # A share of a frame less than a millionth is rounding: 2.0 / 0.1 is 20 frames.
        self._frames = math.ceil(longest / self.settings.shortest_step_s - 1e-6)
        self.memory_size = memory_width(self._frames)

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        self._require_enough_frames(dt)
        v, tau = follower.speed, p["tau"]
        seen = recall(follower.memory, perceive(follower, leader), tau / dt - 1.0)
        # Only over the first tau is more than one step left until the chosen speed is due.
        left = (tau - frames_seen(follower.memory) * dt).clamp(min=dt)
        return (v + (intended_speed(seen, p) - v) * (dt / left)).clamp(min=0.0)

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        return remember(follower.memory, perceive(follower, leader))

    def _require_enough_frames(self, dt: float) -> None:
        if dt < self.settings.shortest_step_s * (1.0 - 1e-6):
            raise ConfigError(
                f"model.shortest_step_s={self.settings.shortest_step_s:g}: the data's time step"
                f" is {dt:g} s, shorter than that; write model.shortest_step_s={dt:g}"
            )
