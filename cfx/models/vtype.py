"""SUMO's vehicle type for a driving model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from torch import Tensor


@dataclass(frozen=True)
class VType:
    """A vehicle type of SUMO, for any number of followers at once.

    Attributes:
        car_follow_model: SUMO's name of the model, such as `Krauss`.
        attributes: by SUMO's names: a tensor that broadcasts to the followers' batch where they may
            differ, or a text for all.
        leader: the same for the vehicle ahead, as some models read what it could do.
        remembers: in SUMO the model may keep a state besides position, speed and acceleration, so
            that a simulation in parts is not the simulation in one.
    """

    car_follow_model: str
    attributes: Mapping[str, Tensor | str]
    leader: Mapping[str, Tensor | str] = field(default_factory=dict)
    remembers: bool = False


@runtime_checkable
class InSumo(Protocol):
    """A driving model that SUMO has too."""

    def sumo_vtype(self, p: Mapping[str, Tensor]) -> VType:
        """Returns the vehicle type that drives as the model does with these parameters.

        Args:
            p: one tensor per parameter, by name, as `DrivingModel.next_speed` gets them.

        Raises:
            ConfigError: as the model is set up, SUMO has none that drives so; says what to set.
        """
