"""Where SUMO may let a vehicle stop next: a light, a junction at which it gives way, a stop."""

from __future__ import annotations

from collections.abc import Iterator

from cfx_sumo.live.surroundings import Connection

_MAY_STOP = frozenset("ruyYs")
"""Lights that are red or yellow, and stop signs, as SUMO calls the states of links."""

_NEAR_M = 0.1
"""m: a place counts as this far ahead at least."""


def stopping_deceleration(connection: Connection, name: str, enough: float) -> float:
    """Returns how hard a vehicle must brake to stop where SUMO may let it stop, m/s2.

    With the speed v and the distance d to such a place that is `v^2 / (2 d)`; the hardest of them.

    Args:
        connection: to the simulation.
        name: of the vehicle.
        enough: m/s2; places at which braking so hard is enough are not looked for.
    """
    speed = float(connection.vehicle.getSpeed(name))
    reach = speed**2 / (2.0 * enough)
    needed = 0.0
    for distance in (*_stops(connection, name), *_links(connection, name, reach)):
        if -_NEAR_M < distance < reach:
            needed = max(needed, speed**2 / (2.0 * max(distance, _NEAR_M)))
    return needed


def _stops(connection: Connection, name: str) -> Iterator[float]:
    """Yields the distance to the vehicle's next stop, m; nothing without one."""
    vehicle = connection.vehicle
    for stop in vehicle.getStops(name, 1):
        edge, _, lane = stop.lane.rpartition("_")
        # Where the stop cannot be reached SUMO answers a distance far below 0.
        yield float(vehicle.getDrivingDistance(name, edge, stop.endPos, int(lane)))


def _links(connection: Connection, name: str, reach: float) -> Iterator[float]:
    """Yields the distances within reach to lights and junctions that are not open, m."""
    vehicle, lane = connection.vehicle, connection.lane
    distance = lane.getLength(vehicle.getLaneID(name)) - vehicle.getLanePosition(name)
    for to_lane, _, is_open, _, _, state, _, length in vehicle.getNextLinks(name):
        if distance > reach:
            return
        if not is_open or state in _MAY_STOP:
            yield distance
        distance += length + lane.getLength(to_lane)
