"""A vehicle of highway-env that a driver of cfx drives along its lane.

config = {"other_vehicles_type": "cfx_drivers.gym.highway.CfxVehicle", "simulation_frequency": 10}
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from highway_env.vehicle.behavior import IDMVehicle

from cfx.errors import ConfigError
from cfx.plugin import DriverState, DriverStep, Motion, composed
from cfx_drivers.gym.drivers import driver_step

LOOK_AHEAD_M = 200.0
"""A vehicle farther ahead, bumper to bumper, is no leader."""


class CfxVehicle(IDMVehicle):  # type: ignore[misc]  # highway-env has no types
    """Follows its leader as a driver of cfx does, and changes lanes as highway-env's IDM vehicle.

    It is that vehicle altogether without a leader within 200 m, while it changes lanes, and after a
    crash; after that the driver begins anew. It keeps to the lane's speed limit. A driven vehicle
    moves with its new speed, as everywhere in cfx, not with its old one, as highway-env's do.

    Attributes:
        driver: who drives: a job's folder or `cfx://NAME`; a subclass may name another.

    Raises:
        ConfigError: the simulation's step is not the driver's.
    """

    driver: ClassVar[str | Path] = "cfx://idm"
    speed: float

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._state: DriverState | None = None
        self._driven: float | None = None
        self._last_speed = float(self.speed)
        self._followed: tuple[Any, float] | None = None

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        super().act(action)
        self._driven = None
        leader, gap = self._leader()
        if leader is None:
            self._state = self._followed = None
            return
        step = _step_of(self.driver)
        if self._state is None:
            self._state = step.begin(1)
        leader_speed = float(np.dot(leader.velocity, self.direction))
        leader_acceleration = 0.0
        if self._followed is not None and self._followed[0] is leader:
            leader_acceleration = (leader_speed - self._followed[1]) / step.dt
        self._followed = (leader, leader_speed)
        noise = None
        if step.noise_width:
            noise = torch.from_numpy(self.road.np_random.standard_normal((1, step.noise_width)))
        speed, self._state = step(
            self._state,
            _motion(self.speed, (self.speed - self._last_speed) / step.dt),
            _motion(leader_speed, leader_acceleration),
            torch.tensor([gap], dtype=torch.float64),
            noise,
        )
        self._driven = float(speed)
        if self.lane.speed_limit is not None:
            slowed = self.speed - composed.COMFORTABLE_BRAKING * step.dt
            self._driven = min(self._driven, max(self.lane.speed_limit, slowed))

    def step(self, dt: float) -> None:
        self._last_speed = float(self.speed)
        if self._driven is not None:
            step_s = _step_of(self.driver).dt
            if abs(dt - step_s) > 1e-6:
                raise ConfigError(
                    f"the simulation steps by {dt:g} s, the driver by {step_s:g} s; configure"
                    f" simulation_frequency={1 / step_s:g}"
                )
            self.speed = self._driven
            self.action["acceleration"] = 0.0  # it has the speed at the step's end already
        super().step(dt)

    def _leader(self) -> tuple[Any, float]:
        """Returns the vehicle that is followed and the gap, m, bumper to bumper; or None and 0."""
        if self.crashed or self.lane_index != self.target_lane_index:
            return None, 0.0
        front, _ = self.road.neighbour_vehicles(self, self.lane_index)
        if front is None:
            return None, 0.0
        gap = float(self.lane_distance_to(front)) - (self.LENGTH + front.LENGTH) / 2
        if gap > LOOK_AHEAD_M:
            return None, 0.0
        return front, gap


@lru_cache(maxsize=16)
def _step_of(driver: str | Path) -> DriverStep:
    """Reads a driver once."""
    return driver_step(driver)


def _motion(speed: float, acceleration: float) -> Motion:
    return Motion(
        torch.tensor([speed], dtype=torch.float64),
        torch.tensor([acceleration], dtype=torch.float64),
    )
