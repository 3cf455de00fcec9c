"""What vehicles of a running SUMO simulation and their leaders do at one instant.

Shapes: D vehicles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cfx.errors import SumoError
from cfx.plugin import FREE_ROAD_M
from cfx_sumo.live.bridge import Read, bridge_of

Connection = Any
"""The module `libsumo`, the module `traci`, or a connection that `traci.getConnection` gives."""


class Seen(NamedTuple):
    """What D vehicles and their leaders do at one instant; `(D,)` each, SI units.

    Attributes:
        speed, acceleration: the follower's.
        gap: bumper to bumper.
        leader_speed, leader_acceleration: of the vehicle ahead.
        allowed: the speed limit that holds for the follower.
        min_gap: the follower's `minGap`, the gap that SUMO's own models keep at a standstill.
    """

    speed: Tensor
    acceleration: Tensor
    gap: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    allowed: Tensor
    min_gap: Tensor

    def rows(self, index: Tensor | slice) -> Seen:
        """Returns some of the vehicles."""
        return Seen(*(signal[index] for signal in self))

    def one_step_later(self, speed: Tensor, dt: float, leaders: Tensor | None = None) -> Seen:
        """Returns what is to be expected one step of a model later.

        Leaders of whom nothing is known go on as they accelerate, and brake to a standstill at
        most.

        Args:
            speed: of the followers then, `(D,)`, m/s.
            dt: the step, s.
            leaders: speed of their leaders then, `(D,)`, m/s; NaN where it is not known; None: it
                is known of none.
        """
        leader_speed = (self.leader_speed + self.leader_acceleration * dt).clamp(min=0.0)
        if leaders is not None:
            leader_speed = torch.where(leaders.isnan(), leader_speed, leaders)
        return self._replace(
            speed=speed,
            acceleration=(speed - self.speed) / dt,
            gap=self.gap + (leader_speed - speed) * dt,
            leader_speed=leader_speed,
            leader_acceleration=(leader_speed - self.leader_speed) / dt,
        )


_SPEED, _ACCELERATION = 0x40, 0x72
_ALLOWED_SPEED, _MIN_GAP, _LEADER = 0xB7, 0x4C, 0x68
"""Numbers of the variables in TraCI's protocol: `traci.constants` would load traci, which none but
its own users need."""

_SUBSCRIBED = (_SPEED, _ACCELERATION, _ALLOWED_SPEED, _MIN_GAP)
"""What is subscribed to, besides the leader."""

_ANOTHER, _NOBODY = -1, -2
"""Places of a leader who is not among the vehicles that are read, and of none."""


class Arrangement(NamedTuple):
    """Who is ahead of whom; mostly the same as an instant ago.

    Attributes:
        requested: the D vehicles that were asked for.
        read: what was read of them as they were arranged so.
        following: those with a leader, F of them.
        leaders: their leaders.
        alone: vehicles without a leader.
        rows: of the leaders among the D vehicles, those that follow first, `(D,)` int64; below 0:
            another vehicle, or none.
        order: which of the vehicles that were asked for each is, `(D,)` int64.
    """

    requested: list[str]
    read: Read
    following: list[str]
    leaders: list[str]
    alone: list[str]
    rows: Tensor
    order: Tensor

    @classmethod
    def of(cls, names: list[str], read: Read) -> Arrangement:
        """Arranges vehicles, those that follow first."""
        order = np.argsort(~read.follows, kind="stable")
        count = int(np.count_nonzero(read.follows))
        following, alone = names, list[str]()
        if count < len(names):
            placed = np.array(names, dtype=object)[order].tolist()
            following, alone = placed[:count], placed[count:]
        ahead = np.array([*names, "", ""], dtype=object)[read.at]
        ahead[read.at == _ANOTHER] = read.others
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        is_among = read.follows & (read.at >= 0)
        among = np.where(is_among, place.take(read.at, mode="clip"), _ANOTHER)[order]
        return cls(
            requested=names,
            read=read,
            following=following,
            leaders=ahead[order[:count]].tolist(),
            alone=alone,
            rows=torch.from_numpy(among),
            order=torch.from_numpy(order),
        )

    def is_still(self, names: list[str], read: Read) -> bool:
        """Says whether vehicles are arranged like this."""
        if self.requested != names or self.read.others != read.others:
            return False
        return read.unchanged or (
            np.array_equal(self.read.at, read.at)
            and np.array_equal(self.read.follows, read.follows)
        )


class View(NamedTuple):
    """Vehicles and who is ahead of them.

    Attributes:
        arrangement: who is ahead of whom; the same object as before where nothing has changed.
        seen: what all D vehicles do, those with a leader first. The others have a leader that is as
            fast as they are, a thousand kilometres ahead.
    """

    arrangement: Arrangement
    seen: Seen

    @property
    def following(self) -> list[str]:
        """Vehicles with a leader, F of them."""
        return self.arrangement.following

    @property
    def leaders(self) -> list[str]:
        """Their leaders."""
        return self.arrangement.leaders

    @property
    def alone(self) -> list[str]:
        """Vehicles without a leader."""
        return self.arrangement.alone

    @property
    def names(self) -> list[str]:
        """All D vehicles, in the order of `seen`."""
        if not self.alone:
            return self.following
        return [*self.following, *self.alone]

    def leader_speeds(self, speed: Tensor, others: Mapping[str, float]) -> Tensor:
        """Returns the speeds of leaders that are driven too, `(D,)`, m/s; NaN of other leaders.

        Args:
            speed: of the D vehicles, `(D,)`, m/s.
            others: of vehicles that other drivers drive, by their ids.
        """
        rows = self.arrangement.rows
        speeds = torch.where(rows < 0, torch.nan, speed[rows])
        if others:
            for row in (rows[: len(self.leaders)] < 0).nonzero().flatten().tolist():
                speeds[row] = others.get(self.leaders[row], torch.nan)
        return speeds


def look(
    connection: Connection, names: list[str], look_ahead: float, before: View | None = None
) -> View:
    """Reads vehicles and their leaders.

    Args:
        connection: to the simulation.
        names: the vehicles.
        look_ahead: m; a vehicle farther ahead is no leader.
        before: what was seen an instant ago, of whatever vehicles.

    Raises:
        SumoError: a vehicle is not in the simulation.
    """
    vehicle = connection.vehicle
    if type(vehicle).__module__.startswith("traci"):
        return view_of(SubscribedReader(vehicle, ("d", look_ahead)), names, look_ahead, before)
    bridge = bridge_of(vehicle)
    if bridge is not None:
        last = None if before is None else before.arrangement
        is_same = last is not None and last.requested == names
        read = bridge.read(
            names, look_ahead, FREE_ROAD_M, last.read if last is not None and is_same else None
        )
        if read is not None:
            return _arranged(names, read, before)
    return view_of(DirectReader(vehicle, look_ahead), names, look_ahead, before)


def lanes_of(connection: Connection, names: Sequence[str]) -> list[str]:
    """Returns the lane of each vehicle, by SUMO's ids."""
    bridge = bridge_of(connection.vehicle)
    if bridge is not None:
        lanes = bridge.lanes(names)
        if lanes is not None:
            return lanes
    return [connection.vehicle.getLaneID(name) for name in names]


def view_of(
    reader: DirectReader | SubscribedReader,
    names: list[str],
    look_ahead: float,
    before: View | None = None,
) -> View:
    """Reads vehicles and their leaders in one of the two ways; as `look`."""
    try:
        return _arranged(names, _read(reader, names, look_ahead), before)
    except Exception as error:
        # libsumo's and traci's are two classes of this name.
        if type(error).__name__ != "TraCIException":
            raise
        raise SumoError(
            f"{_culprit(reader, names)} cannot be driven ({error}); step only vehicles of"
            " connection.vehicle.getIDList()"
        ) from error


def _read(reader: DirectReader | SubscribedReader, names: list[str], look_ahead: float) -> Read:
    """Reads vehicles and who is ahead of them, as `bridge.cpp` does.

    SUMO's own gap leaves `minGap` out. At some junctions TraCI answers a leader at -1.8e308 m,
    which is none.
    """
    rows = [reader.row(name) for name in names]
    ahead = [leader[0] if leader else "" for leader, *_ in rows]
    values = np.array([(leader[1] if leader else np.inf, *row) for leader, *row in rows])
    raw, speed, acceleration, min_gap, allowed = values.reshape(-1, 5).T
    places = {name: row for row, name in enumerate(names)} | {"": _NOBODY}
    at = np.array([places.get(name, _ANOTHER) for name in ahead], dtype=np.int64)
    gap = raw + min_gap
    follows = (at != _NOBODY) & (np.abs(raw) <= FREE_ROAD_M) & (gap <= look_ahead)
    leader_speed = np.where(follows, speed.take(at, mode="clip"), speed)
    leader_acceleration = np.where(follows, acceleration.take(at, mode="clip"), 0.0)
    for row in (follows & (at == _ANOTHER)).nonzero()[0].tolist():
        leader_speed[row], leader_acceleration[row] = reader.motion(ahead[row])
    signals = [
        speed,
        acceleration,
        np.where(follows, gap, FREE_ROAD_M),
        leader_speed,
        leader_acceleration,
        allowed,
        np.where(follows, min_gap, 0.0),
    ]
    others = [name for name in ahead if name not in places]
    return Read(at, others, follows, np.stack(signals))


def _arranged(names: list[str], read: Read, before: View | None) -> View:
    """Returns vehicles and their leaders, those with a leader first."""
    if before is not None and before.arrangement.is_still(names, read):
        arrangement = before.arrangement
    else:
        arrangement = Arrangement.of(names, read)
    signals = read.signals
    if arrangement.alone:
        signals = signals[:, arrangement.order.numpy()]
    return View(arrangement, Seen(*torch.from_numpy(signals).unbind()))


def _culprit(reader: DirectReader | SubscribedReader, names: list[str]) -> str:
    """Returns the first vehicle that SUMO does not know, in words."""
    for name in names:
        try:
            reader.motion(name)
        except Exception:
            return f"vehicle '{name}'"
    return "a vehicle"


_Row = tuple[tuple[str, float] | None, float, float, float, float]
"""The next vehicle ahead and the gap to it without `minGap`, m; speed, acceleration, `minGap` and
allowed speed."""


class DirectReader:
    """Reads by calls, a value each.

    In libsumo a call costs less than what SUMO does to serve a subscription.
    """

    def __init__(self, vehicle: Any, look_ahead: float) -> None:
        self._vehicle = vehicle
        self._look_ahead = look_ahead

    def row(self, name: str) -> _Row:
        """Returns what SUMO says of a vehicle."""
        vehicle = self._vehicle
        return (
            vehicle.getLeader(name, self._look_ahead),
            vehicle.getSpeed(name),
            vehicle.getAcceleration(name),
            vehicle.getMinGap(name),
            vehicle.getAllowedSpeed(name),
        )

    def motion(self, name: str) -> tuple[float, float]:
        """Returns a vehicle's speed, m/s, and acceleration, m/s2."""
        return self._vehicle.getSpeed(name), self._vehicle.getAcceleration(name)


class SubscribedReader:
    """Reads what SUMO sends with each of its steps: no call for a value, as each is a message.

    A vehicle is subscribed to as it is first read, and its leader too. What was changed after the
    last step of the simulation is seen after the next one.
    """

    def __init__(self, vehicle: Any, distance: object) -> None:
        """Takes what SUMO has sent.

        Args:
            vehicle: of the connection.
            distance: within which a leader counts, m, as the connection takes it: traci a type and
                a number, libsumo a number.
        """
        self._vehicle = vehicle
        self._distance = distance
        self._known: Mapping[str, Mapping[int, Any]] = vehicle.getAllSubscriptionResults()
        self._new: dict[str, Mapping[int, Any]] = {}

    def row(self, name: str) -> _Row:
        """Returns what SUMO says of a vehicle."""
        row = self._values(name, _LEADER)
        motion = row[_SPEED], row[_ACCELERATION]
        return (row[_LEADER], *motion, row[_MIN_GAP], row[_ALLOWED_SPEED])

    def motion(self, name: str) -> tuple[float, float]:
        """Returns a vehicle's speed, m/s, and acceleration, m/s2."""
        values = self._values(name, _SPEED)
        return values[_SPEED], values[_ACCELERATION]

    def _values(self, name: str, needed: int) -> Mapping[int, Any]:
        """Returns what is subscribed to of a vehicle, in which `needed` must be."""
        values = self._new.get(name) or self._known.get(name, {})
        if needed not in values:
            if needed == _LEADER:
                variables = (*_SUBSCRIBED, _LEADER)
                self._vehicle.subscribe(name, variables, parameters={_LEADER: self._distance})
            else:
                self._vehicle.subscribe(name, (_SPEED, _ACCELERATION))
            values = self._vehicle.getSubscriptionResults(name)
            self._new[name] = values
        return values
