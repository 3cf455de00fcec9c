"""A simulator: how a model's speeds become trajectories. This one sums them up in another way.

A job asks for one `stepper` per model. Calibration calls its `advance` for a stretch of time,
and training and evaluation its `step` for one step at a time, both for many drivers at once.

M. Treiber and V. Kanagaraj (2015), Comparing numerical integration schemes for time-continuous
car-following models, Physica A 419, 183-195.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from cfx.plugin import DrivingModel, Follower, Leader, Simulator, SimulatorSettings, Stepper
from pydantic import Field
from torch import Tensor


class MeanSpeedSettings(SimulatorSettings):
    """Settings of `mean_speed`."""

    weight: float = Field(
        0.5,
        ge=0,
        le=1,
        description="share of the new speed in a step; 0.5: ballistic, 1: cfx's own",
    )


class MeanSpeed(Simulator):
    """The model's own equations; positions move by a mean of the speeds around each step."""

    schema = MeanSpeedSettings
    settings: MeanSpeedSettings
    differentiable = True

    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        self.require(model)
        return MeanSpeedStepper(model, dt, self.settings.weight)


class MeanSpeedStepper(Stepper):
    """Takes the steps of one model.

    v' = model(...), then x' = x + (weight v' + (1 - weight) v) dt.
    """

    differentiable = True

    def __init__(self, model: DrivingModel, dt: float, weight: float) -> None:
        super().__init__(model, dt)
        self.weight = weight

    def advance(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]
    ) -> tuple[Follower, Tensor, Tensor]:
        steps = len(leader.position)
        if steps == 0:
            nothing = follower.speed.new_empty((0, *follower.speed.shape))
            return follower, nothing, nothing
        positions, speeds = [], []
        for k in range(steps):
            now = Leader(leader.position[k], leader.speed[k], leader.acceleration[k], leader.length)
            follower = self.step(follower, now, p)
            positions.append(follower.position)
            speeds.append(follower.speed)
        return follower, torch.stack(positions), torch.stack(speeds)

    def step(self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]) -> Follower:
        speed = self.model.next_speed(follower, leader, p, self.dt)
        memory = self.model.next_memory(follower, leader, p, self.dt, speed)
        mean = torch.lerp(follower.speed, speed, self.weight)
        acceleration = (speed - follower.speed) / self.dt
        return Follower(follower.position + mean * self.dt, speed, acceleration, memory)

    def identity(self) -> str:
        return f"cfx-example 0.1.0 weight={self.weight}"
