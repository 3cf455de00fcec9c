"""What vehicles of a running SUMO simulation and their leaders do at one instant.

Shapes: D vehicles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.core.errors import SumoError

Connection = Any
"""The module `libsumo`, the module `traci`, or a connection that `traci.getConnection` gives."""


class Seen(NamedTuple):
    """What D vehicles and their leaders do at one instant; `(D,)` each, SI units.

    Attributes:
        speed, acceleration: the follower's.
        gap: bumper to bumper.
        leader_speed, leader_acceleration, leader_length: of the vehicle ahead.
        allowed: the speed limit that holds for the follower.
        min_gap: the follower's `minGap`, the gap that SUMO's own models keep at a standstill.
    """

    speed: Tensor
    acceleration: Tensor
    gap: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    leader_length: Tensor
    allowed: Tensor
    min_gap: Tensor

    def rows(self, index: Tensor | slice) -> Seen:
        """Returns some of the vehicles."""
        return Seen(*(signal[index] for signal in self))

    def one_step_later(self, speed: Tensor, dt: float) -> Seen:
        """Returns what is to be expected one step of a model later.

        Leaders go on as they accelerate, and brake to a standstill at most.

        Args:
            speed: of the followers then, `(D,)`, m/s.
            dt: the step, s.
        """
        leader_speed = (self.leader_speed + self.leader_acceleration * dt).clamp(min=0.0)
        return self._replace(
            speed=speed,
            acceleration=(speed - self.speed) / dt,
            gap=self.gap + (leader_speed - speed) * dt,
            leader_speed=leader_speed,
            leader_acceleration=(leader_speed - self.leader_speed) / dt,
        )


class View(NamedTuple):
    """Vehicles and who is ahead of them.

    Attributes:
        following: vehicles with a leader, F of them.
        leaders: their leaders.
        alone: vehicles without a leader.
        seen: what all of them do, those with a leader first. The others have a leader that is as
            fast as they are, a thousand kilometres ahead.
    """

    following: list[str]
    leaders: list[str]
    alone: list[str]
    seen: Seen


def look(connection: Connection, names: list[str], look_ahead: float) -> View:
    """Reads vehicles and their leaders.

    Args:
        connection: to the simulation.
        names: the vehicles.
        look_ahead: m; a vehicle farther ahead is no leader.

    Raises:
        SumoError: a vehicle is not in the simulation.
    """
    reader = _Reader(connection)
    following, leaders, alone, rows = [], [], [], []
    for name in names:
        leader = leader_of(connection, name, look_ahead)
        if leader is None:
            alone.append(name)
        else:
            following.append(name)
            leaders.append(leader[0])
            rows.append(reader.row(name, *leader))
    rows += [reader.row_alone(name) for name in alone]
    table = torch.tensor(rows, dtype=torch.float64).reshape(-1, len(Seen._fields))
    return View(following, leaders, alone, Seen(*table.unbind(1)))


_FARTHEST = 1e6
"""m: no gap is larger."""


def leader_of(connection: Connection, name: str, look_ahead: float) -> tuple[str, float] | None:
    """Returns the vehicle ahead and the gap from bumper to bumper, m.

    Returns:
        None if no vehicle is within `look_ahead`.

    Raises:
        SumoError: the vehicle is not in the simulation.
    """
    try:
        leader = connection.vehicle.getLeader(name, look_ahead)
    except Exception as error:
        # libsumo's and traci's are two classes of this name.
        if type(error).__name__ != "TraCIException":
            raise
        raise SumoError(
            f"vehicle '{name}' cannot be driven ({error}); step only vehicles of"
            " connection.vehicle.getIDList()"
        ) from error
    # At some junctions TraCI answers a leader at -1.8e308 m, which is none.
    if not leader or not leader[0] or abs(leader[1]) > _FARTHEST:
        return None
    gap = leader[1] + connection.vehicle.getMinGap(name)  # SUMO's own gap leaves minGap out
    if gap > look_ahead:
        return None
    return leader[0], gap


class _Reader:
    """Reads each vehicle's motion once: a follower is the next one's leader, and TraCI is slow."""

    def __init__(self, connection: Connection) -> None:
        self._vehicle = connection.vehicle
        self._motions: dict[str, tuple[float, float]] = {}

    def row(self, name: str, leader: str, gap: float) -> tuple[float, ...]:
        """Returns the fields of `Seen` for one vehicle."""
        speed, acceleration = self._motion(name)
        leader_speed, leader_acceleration = self._motion(leader)
        length = self._vehicle.getLength(leader)
        allowed = self._vehicle.getAllowedSpeed(name)
        min_gap = self._vehicle.getMinGap(name)
        return speed, acceleration, gap, leader_speed, leader_acceleration, length, allowed, min_gap

    def row_alone(self, name: str) -> tuple[float, ...]:
        """Returns the fields of `Seen` for a vehicle without a leader."""
        speed, acceleration = self._motion(name)
        allowed = self._vehicle.getAllowedSpeed(name)
        return speed, acceleration, _FARTHEST, speed, 0.0, 0.0, allowed, 0.0

    def _motion(self, name: str) -> tuple[float, float]:
        if name not in self._motions:
            speed = self._vehicle.getSpeed(name)
            self._motions[name] = speed, self._vehicle.getAcceleration(name)
        return self._motions[name]
