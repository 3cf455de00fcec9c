"""SUMO around a driving model: its vehicle type, and its Euler step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
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


_HALTING = 1e-4
"""m/s2: SUMO stops a vehicle that is slower than what this reaches within a step."""


def sumo_speed(
    v: Tensor,
    proposed: Tensor,
    *,
    accel: Tensor,
    decel: Tensor,
    emergency_decel: Tensor,
    v_max: Tensor,
    dt: float,
) -> Tensor:
    """Returns the speed `(*batch,)`, m/s, that SUMO realises when a model wants `proposed`.

    With `top = min(v + accel dt, v_max)` the plan is `min(top, wanted)`; it is bounded by 0 and by
    `v - emergency_decel dt`, so that `emergency_decel` is the brake cap, not `decel`, unless that
    is the larger one. Speeds below `_HALTING dt` become 0: 1e-5 m/s at 0.1 s. The lane's limit is
    taken to be above `v_max`.

    Args:
        v: speed now, m/s.
        proposed: speed that the model asks for, m/s; may be negative.
        accel, decel, emergency_decel: m/s2, positive.
        v_max: m/s.
        dt: time step, s.
    """
    top = torch.minimum(v + accel * dt, v_max)
    comfortable = (v - decel * dt).clamp(min=0.0)
    plan = torch.minimum(top, proposed)
    hardest = torch.minimum(comfortable, (v - emergency_decel * dt).clamp(min=0.0))
    speed = torch.maximum(plan, hardest)
    return torch.where(speed.abs() < _HALTING * dt, 0.0, speed)
