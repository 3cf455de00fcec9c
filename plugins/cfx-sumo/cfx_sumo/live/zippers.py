"""Whom vehicles let go first where two lanes become one by turns: SUMO's zippers.

SUMO names a leader on the other lane only as that one enters the junction, a few metres ahead. Its
own check of who goes first then stops the follower at the line: each vehicle of two queues starts
from a standstill there. People follow whoever goes before them some time earlier. So does a driver
here, from as far away as SUMO's own models look at a zipper.

Shapes: D vehicles, Z of them behind another one on the other lane of a zipper.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from cfx_sumo.live.surroundings import Connection, Seen

REACH_M = 100.0
"""How far before a zipper SUMO's models look at who comes on the other lane, m (its documentation:
`visibility` of a connection)."""

EASY_MPS2 = 1.5
"""How hard a vehicle brakes at most to let another one go first, m/s2: comfortably (M. Treiber and
A. Kesting, 2013, *Traffic Flow Dynamics*, table 11.2). What more is needed SUMO asks for."""

_NEAREST_M = 0.2
"""Vehicles side by side count as this far apart, m."""

_ZIPPER = "Z"
"""State of a zipper's links, as SUMO calls it."""

_STATE, _LENGTH = 5, 7
"""Places in what SUMO says of a link."""


class Coming(NamedTuple):
    """A vehicle that comes to a zipper; the nearest is the smallest.

    Attributes:
        distance: to its line, m.
        before: the lane that ends there.
        name: of the vehicle.
    """

    distance: float
    before: str
    name: str


class Turns(NamedTuple):
    """Who is behind whom at zippers.

    Attributes:
        places: which of the D vehicles are behind another one, `(Z,)` int64.
        seen: what they do, with the one that goes first as the leader, `(Z,)` each.
    """

    places: Tensor
    seen: Seen

    def one_step_later(self, speed: Tensor, dt: float) -> Turns:
        """Returns what is to be expected one step of a model later.

        Args:
            speed: of the Z vehicles then, `(Z,)`, m/s.
            dt: the step, s.
        """
        later = self.seen.one_step_later(speed, dt)
        return self._replace(seen=later._replace(gap=later.gap.clamp(min=_NEAREST_M)))


class Zippers:
    """The zippers of a simulation's network.

    Attributes:
        lanes: from which a zipper is within `REACH_M`; none in most networks, where nothing is
            asked of SUMO any more.
    """

    def __init__(self, connection: Connection) -> None:
        self.lanes = tuple(_lanes_to_zippers(connection))

    def turns(self, connection: Connection, names: Sequence[str], seen: Seen) -> Turns | None:
        """Finds the vehicles that are behind another one of the other lane.

        Args:
            connection: to the simulation.
            names: the D vehicles that are driven.
            seen: what they do.

        Returns:
            Them; None: there are none.
        """
        behind = self._behind(connection)
        places = [place for place, name in enumerate(names) if name in behind]
        if not places:
            return None
        vehicle, rows = connection.vehicle, torch.tensor(places)
        gaps, motions = [], []
        for place in places:
            first, distance = behind[names[place]]
            gaps.append(max(distance - vehicle.getLength(first), _NEAREST_M))
            motions.append((vehicle.getSpeed(first), vehicle.getAcceleration(first)))
        speed, acceleration = torch.tensor(motions, dtype=torch.float64).unbind(1)
        leading = seen.rows(rows)._replace(
            gap=torch.tensor(gaps, dtype=torch.float64),
            leader_speed=speed,
            leader_acceleration=acceleration,
        )
        return Turns(rows, leading)

    def _behind(self, connection: Connection) -> dict[str, tuple[str, float]]:
        """Returns, of each vehicle behind one of the other lane, that one and how far ahead.

        A vehicle that could not fall behind within a second by braking goes first for SUMO, if it
        arrives first. So it follows nobody.
        """
        behind, vehicle = {}, connection.vehicle
        for coming in self._coming(connection).values():
            # The last one on another lane among those nearer to the line.
            other: Coming | None = None
            for nearer, follower in pairwise(sorted(coming)):
                if nearer.before != follower.before:
                    other = nearer
                if other is None:
                    continue
                apart = follower.distance - other.distance
                faster = vehicle.getSpeed(follower.name) - vehicle.getSpeed(other.name)
                if apart > faster - vehicle.getDecel(follower.name):
                    behind[follower.name] = (other.name, apart)
        return behind

    def _coming(self, connection: Connection) -> dict[str, list[Coming]]:
        """Returns the vehicles that come to each zipper, by the lane behind it."""
        coming = defaultdict(list)
        for lane in self.lanes:
            for name in connection.lane.getLastStepVehicleIDs(lane):
                next_zipper = _next_zipper(connection, lane, name)
                if next_zipper is not None:
                    coming[next_zipper[0]].append(next_zipper[1])
        return coming


def _lanes_to_zippers(connection: Connection) -> dict[str, float]:
    """Returns lanes and how far beyond their ends a zipper is, less than `REACH_M`, m."""
    lane = connection.lane
    links = {name: lane.getLinks(name) for name in lane.getIDList()}
    beyond = {}
    before: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for name, leaving in links.items():
        for link in leaving:
            before[link[0]].append((name, link[_LENGTH]))
            if link[_STATE] == _ZIPPER:
                beyond[name] = 0.0
    newest = list(beyond)
    while newest:
        farther = []
        for name in newest:
            for earlier, length in before[name]:
                distance = beyond[name] + lane.getLength(name) + length
                if distance < min(REACH_M, beyond.get(earlier, math.inf)):
                    beyond[earlier] = distance
                    farther.append(earlier)
        newest = farther
    return beyond


def _next_zipper(connection: Connection, at: str, name: str) -> tuple[str, Coming] | None:
    """Returns the lane behind the next zipper within reach of a vehicle, and how it comes there.

    Args:
        connection: to the simulation.
        at: the vehicle's lane.
        name: of the vehicle.
    """
    vehicle, lane = connection.vehicle, connection.lane
    distance = lane.getLength(at) - vehicle.getLanePosition(name)
    for link in vehicle.getNextLinks(name):
        if distance > REACH_M:
            return None
        if link[_STATE] == _ZIPPER:
            return link[0], Coming(distance, at, name)
        at = link[0]
        distance += link[_LENGTH] + lane.getLength(at)
    return None
