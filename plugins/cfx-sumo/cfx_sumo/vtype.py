"""Any car-following model of SUMO's, by its name (`sumo_vtype`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, NoReturn

from pydantic import Field
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import (
    DrivingModel,
    Follower,
    Leader,
    ModelSettings,
    ParameterOverride,
    ParameterSpace,
    Settings,
    VType,
)

_UNITS = {
    "tau": "s",
    "actionStepLength": "s",
    "startupDelay": "s",
    "treaction": "s",
    "tpreview": "s",
    "tPersDrive": "s",
    "tPersEstimate": "s",
    "stepping": "s",
    "accel": "m/s2",
    "decel": "m/s2",
    "emergencyDecel": "m/s2",
    "apparentDecel": "m/s2",
    "taccmax": "m/s2",
    "maxSpeed": "m/s",
    "desiredMaxSpeed": "m/s",
    "speedFactor": "1",
    "sigma": "1",
    "delta": "1",
    "collisionMinGapFactor": "1",
    "ccoolness": "1",
    "minGap": "m",
    "jerkmax": "m/s3",
}
_RANDOM = ("sigmaleader", "sigmagap", "sigmaerror")
"""Attributes by which EIDM is random; `sigma` of others is 0 unless it is given, too."""


class SumoVTypeSettings(ModelSettings):
    """Settings of `sumo_vtype`."""

    car_follow_model: str = Field(
        "EIDM", description="SUMO's name of the model: Krauss, IDM, EIDM, W99, Wiedemann, ACC ..."
    )
    parameters: dict[str, ParameterOverride] = Field(
        description="vType attributes with low, high and default, by SUMO's names"
    )
    attributes: dict[str, float | str] | None = Field(
        None, description="vType attributes that stay as they are; all others are SUMO's defaults"
    )


class SumoVType(DrivingModel):
    """Whatever SUMO drives: its parameters are vType attributes, by SUMO's names, from the config.

        model=sumo_vtype model.car_follow_model=EIDM
        'model.parameters={tau: {low: 0.5, high: 3, default: 1}}'

    It has no equations here, so it needs `simulator=sumo`. What is neither a parameter nor in
    `attributes` has SUMO's default, but for what is random: sigma (0.5 in SUMO's Krauss)
    and EIDM's sigmaleader, sigmagap and sigmaerror are 0 unless they are given. Some models draw
    random numbers all the same (W99, Wiedemann): the same request gives the same trajectories,
    but a follower on another road draws other numbers.

    Differences from SUMO: none.
    """

    reference = "SUMO's own definition of vehicle types"
    schema: ClassVar[type[Settings]] = SumoVTypeSettings
    settings: SumoVTypeSettings
    differentiable = False
    needs_simulator = "sumo"
    parameters = ParameterSpace((), open=True)

    def __init__(self, settings: Settings | None = None, **options: object) -> None:
        super().__init__(settings, **options)
        described = []
        for parameter in self.space:
            unit = _UNITS.get(parameter.name, "SUMO's unit")
            described.append(replace(parameter, unit=unit, meaning=f"SUMO's {parameter.name}"))
        self.space = ParameterSpace(tuple(described))
        attributes = self.settings.attributes or {}
        for parameter in self.space:
            if parameter.name in attributes:
                raise ConfigError(
                    f"model.attributes.{parameter.name}: it is among model.parameters too; give it"
                    " once"
                )

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> NoReturn:
        raise ConfigError(
            "model=sumo_vtype has no equations in Python; add simulator=sumo, which alone drives it"
        )

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        name = self.settings.car_follow_model
        attributes: dict[str, Tensor | str] = {}
        if name == "EIDM":
            attributes.update(dict.fromkeys(_RANDOM, "0"))
        for key, value in (self.settings.attributes or {}).items():
            attributes[key] = value if isinstance(value, str) else repr(value)
        attributes.update(p)
        return VType(name, attributes, remembers=True)
