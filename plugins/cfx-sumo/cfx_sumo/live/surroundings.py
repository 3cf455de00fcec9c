"""What vehicles of a running SUMO simulation and their leaders do at one instant.

Shapes: D vehicles.
"""

from __future__ import annotations

from collections.abc import Mapping
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


_SPEED, _ACCELERATION, _LENGTH = 0x40, 0x72, 0x44
_ALLOWED_SPEED, _MIN_GAP, _LEADER = 0xB7, 0x4C, 0x68
"""Numbers of the variables in TraCI's protocol: `traci.constants` would load traci, which none but
its own users need."""

_SUBSCRIBED = (_SPEED, _ACCELERATION, _LENGTH, _ALLOWED_SPEED, _MIN_GAP)
"""What is subscribed to, besides the leader."""


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
    reader: DirectReader | SubscribedReader
    if type(connection.vehicle).__module__.startswith("traci"):
        reader = SubscribedReader(connection.vehicle, look_ahead, ("d", look_ahead))
    else:
        reader = DirectReader(connection.vehicle, look_ahead)
    return view_of(reader, names)


def view_of(reader: DirectReader | SubscribedReader, names: list[str]) -> View:
    """Reads vehicles and their leaders in one of the two ways; as `look`."""
    following, leaders, alone = [], [], []
    rows: list[tuple[float, ...]] = []
    rows_alone: list[tuple[float, ...]] = []
    try:
        for name in names:
            leader, row = reader.row(name)
            if leader is None:
                alone.append(name)
                rows_alone.append(row)
            else:
                following.append(name)
                leaders.append(leader)
                rows.append(row)
    except Exception as error:
        # libsumo's and traci's are two classes of this name.
        if type(error).__name__ != "TraCIException":
            raise
        raise SumoError(
            f"vehicle '{name}' cannot be driven ({error}); step only vehicles of"
            " connection.vehicle.getIDList()"
        ) from error
    table = torch.tensor(rows + rows_alone, dtype=torch.float64).reshape(-1, len(Seen._fields))
    return View(following, leaders, alone, Seen(*table.unbind(1)))


_FARTHEST = 1e6
"""m: no gap is larger."""


def _gap_to(leader: tuple[str, float] | None, min_gap: float, look_ahead: float) -> float | None:
    """Returns the gap from bumper to bumper, m; None without a leader within `look_ahead`.

    SUMO's own gap leaves `minGap` out. At some junctions TraCI answers a leader at -1.8e308 m,
    which is none.
    """
    if not leader or not leader[0] or abs(leader[1]) > _FARTHEST:
        return None
    gap = leader[1] + min_gap
    return gap if gap <= look_ahead else None


class DirectReader:
    """Reads by calls, a value each, and each vehicle's motion once: a follower is often a leader.

    In libsumo a call costs less than what SUMO does to serve a subscription.
    """

    def __init__(self, vehicle: Any, look_ahead: float) -> None:
        self._vehicle = vehicle
        self._look_ahead = look_ahead
        self._motions: dict[str, tuple[float, float]] = {}

    def row(self, name: str) -> tuple[str | None, tuple[float, ...]]:
        """Returns a vehicle's leader, and the fields of `Seen`."""
        vehicle = self._vehicle
        leader = vehicle.getLeader(name, self._look_ahead)
        min_gap = vehicle.getMinGap(name)
        speed, acceleration = self._motion(name)
        allowed = vehicle.getAllowedSpeed(name)
        gap = _gap_to(leader, min_gap, self._look_ahead)
        if gap is None:
            return None, (speed, acceleration, _FARTHEST, speed, 0.0, 0.0, allowed, 0.0)
        ahead = leader[0]
        length = vehicle.getLength(ahead)
        return ahead, (speed, acceleration, gap, *self._motion(ahead), length, allowed, min_gap)

    def _motion(self, name: str) -> tuple[float, float]:
        motion = self._motions.get(name)
        if motion is None:
            motion = self._vehicle.getSpeed(name), self._vehicle.getAcceleration(name)
            self._motions[name] = motion
        return motion


class SubscribedReader:
    """Reads what SUMO sends with each of its steps: no call for a value, as each is a message.

    A vehicle is subscribed to as it is first read, and its leader too. What was changed after the
    last step of the simulation is seen after the next one.
    """

    def __init__(self, vehicle: Any, look_ahead: float, distance: object) -> None:
        """Takes what SUMO has sent.

        Args:
            vehicle: of the connection.
            look_ahead: m; a vehicle farther ahead is no leader.
            distance: the same as the connection takes it: traci a type and a number, libsumo a
                number.
        """
        self._vehicle = vehicle
        self._look_ahead = look_ahead
        self._distance = distance
        self._known: Mapping[str, Mapping[int, Any]] = vehicle.getAllSubscriptionResults()
        self._new: dict[str, Mapping[int, Any]] = {}

    def row(self, name: str) -> tuple[str | None, tuple[float, ...]]:
        """Returns a vehicle's leader, and the fields of `Seen`."""
        own = self._values(name, _LEADER)
        leader, min_gap = own[_LEADER], own[_MIN_GAP]
        speed, acceleration = own[_SPEED], own[_ACCELERATION]
        allowed = own[_ALLOWED_SPEED]
        gap = _gap_to(leader, min_gap, self._look_ahead)
        if gap is None:
            return None, (speed, acceleration, _FARTHEST, speed, 0.0, 0.0, allowed, 0.0)
        ahead = self._values(leader[0], _LENGTH)
        motion = ahead[_SPEED], ahead[_ACCELERATION]
        length = ahead[_LENGTH]
        return leader[0], (speed, acceleration, gap, *motion, length, allowed, min_gap)

    def _values(self, name: str, needed: int) -> Mapping[int, Any]:
        """Returns what is subscribed to of a vehicle, in which `needed` must be."""
        values = self._new.get(name) or self._known.get(name, {})
        if needed not in values:
            if needed == _LEADER:
                variables = (*_SUBSCRIBED, _LEADER)
                self._vehicle.subscribe(name, variables, parameters={_LEADER: self._distance})
            else:
                self._vehicle.subscribe(name, _SUBSCRIBED)
            values = self._vehicle.getSubscriptionResults(name)
            self._new[name] = values
        return values
