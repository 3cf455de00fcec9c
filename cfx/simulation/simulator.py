"""The contract of a simulator: it says which driving models it can drive, and takes their steps."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from pydantic import Field

from cfx.core import registry
from cfx.core.component import Component, Settings
from cfx.core.errors import ConfigError
from cfx.models.base import DrivingModel
from cfx.simulation.base import Stepper


class SimulatorSettings(Settings):
    """Settings that every simulator has."""

    memory_mb: int = Field(
        1024, ge=16, description="bound for what one chunk of calibration problems takes, MB"
    )


class Simulator(Component):
    """Base of every simulator.

    Life cycle: constructed once per job, before any work. `require` is asked first, and a job whose
    driving model it refuses ends there; then `stepper` is called once, with the recordings' time
    step. Constructing and `require` start nothing.

    A subclass implements `stepper`. One that does not use the model's equations says in `require`
    which models it can drive.

    Attributes:
        differentiable: gradients flow through the steps. Tested.
    """

    kind = "simulator"
    schema: ClassVar[type[Settings]] = SimulatorSettings
    settings: SimulatorSettings

    differentiable: ClassVar[bool] = False

    def require(self, model: DrivingModel) -> None:
        """Checks that this simulator can drive a model; the base class asks for equations.

        Raises:
            ConfigError: it cannot; says what to choose.
            CfxError: another one where something is not installed that the simulator needs.
        """
        if model.needs_simulator:
            raise ConfigError(
                f"model={registry.name_of(model)} has no equations in Python; add"
                f" simulator={model.needs_simulator}, which alone drives it"
            )

    @abstractmethod
    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        """Returns what takes the steps of one model at one time step.

        Args:
            model: one that `require` lets through.
            dt: time step, s.

        Raises:
            ConfigError: the simulator cannot drive the model, or not at this time step.
        """
