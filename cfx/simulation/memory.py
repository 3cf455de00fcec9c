"""`simulator=memory`: the model's own equations, for all followers at once."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cfx.core.component import Settings
from cfx.models.base import DrivingModel
from cfx.simulation.base import Stepper
from cfx.simulation.rollout import Compile, MemoryStepper
from cfx.simulation.simulator import Simulator, SimulatorSettings


class MemorySettings(SimulatorSettings):
    """Settings of `memory`."""

    compile: Compile = Field("auto", description="compile the model's step: auto: where it pays")


class MemorySimulator(Simulator):
    """The model's own equations take the steps, for all followers at once."""

    differentiable = True
    schema: ClassVar[type[Settings]] = MemorySettings
    settings: MemorySettings

    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        self.require(model)
        return MemoryStepper(model, dt, compile=self.settings.compile)
