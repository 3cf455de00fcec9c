"""`simulator=sumo`: the same rollouts, with SUMO taking the steps."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cfx.plugin import DrivingModel, Settings, Simulator, SimulatorSettings, Stepper
from cfx_sumo.simulation.stepper import SumoStepper, require_in_sumo


class SumoSettings(SimulatorSettings):
    """Settings of `sumo`."""

    workers: int | None = Field(None, ge=1, description="SUMO processes; null: one for each core")
    followers: int = Field(
        50,
        ge=1,
        le=4000,
        description="followers in one network, each on its own road; 10 to 100 is fastest",
    )
    seed: int = Field(
        23423, ge=0, lt=2**31, description="SUMO's own seed, for models that draw random numbers"
    )


class SumoSimulator(Simulator):
    """SUMO takes the steps (pip install "cfx-driving[sumo]"); a hundred times slower than memory.

    For models that SUMO has: krauss_sumo, idm_sumo, w99, krauss without t_i, and any of its own by
    name with model=sumo_vtype. No gradients.
    """

    schema: ClassVar[type[Settings]] = SumoSettings
    settings: SumoSettings

    def require(self, model: DrivingModel) -> None:
        require_in_sumo(model)

    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        s = self.settings
        return SumoStepper(model, dt, workers=s.workers, followers=s.followers, seed=s.seed)
