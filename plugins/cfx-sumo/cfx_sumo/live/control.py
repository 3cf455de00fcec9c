"""Speed modes and bounds on braking of driven vehicles, and how SUMO gets them back."""

from __future__ import annotations

from collections.abc import Iterable, KeysView, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from cfx_sumo.live.stops import stopping_deceleration
from cfx_sumo.live.surroundings import Connection


@dataclass(frozen=True)
class RaisedDecel:
    """The `decel` of a vehicle that must brake harder than its vType says.

    Attributes:
        vtype: what it had before.
        usual: its `decel` there, m/s2.
        bound: its `decel` now, m/s2.
    """

    vtype: str
    usual: float
    bound: float


class VehicleControl:
    """Takes vehicles out of the hands of SUMO's own models, and gives them back.

    SUMO's bound on braking, `decel`, is raised where a vehicle must brake harder, never above its
    vType's `emergencyDecel`. It is lowered again as soon as the vehicle can stop with less where
    SUMO may let it stop next (`stopping_deceleration`): SUMO has planned with the raised one.

    For a raised `decel` SUMO makes a vType of this vehicle alone (`car@7` of `car`). One that a
    saved state brought stays in the simulation for good, and SUMO makes no second one of that name;
    it is used again.

    Args:
        speed_mode: SUMO's bit set of `vehicle.setSpeedMode` while a vehicle is driven.
    """

    def __init__(self, speed_mode: int) -> None:
        self.speed_mode = speed_mode
        self._modes: dict[str, int] = {}
        self._raised: dict[str, RaisedDecel] = {}
        self._loaded_types: frozenset[str] = frozenset()

    @property
    def driven(self) -> KeysView[str]:
        """The vehicles that are driven now."""
        return self._modes.keys()

    def drives(self, name: str) -> bool:
        """Says whether a vehicle is driven now."""
        return name in self._modes

    def take(self, connection: Connection, name: str) -> None:
        """Takes a vehicle."""
        self._modes.setdefault(name, connection.vehicle.getSpeedMode(name))
        connection.vehicle.setSpeedMode(name, self.speed_mode)

    def give_back(self, connection: Connection, name: str) -> None:
        """Lets SUMO's own model drive a vehicle again, with its own speed mode and `decel`.

        A raised `decel` that SUMO still needs stays until `bound_braking` can lower it.
        """
        mode = self._modes.pop(name, None)
        if mode is None:
            return
        connection.vehicle.setSpeed(name, -1)
        connection.vehicle.setSpeedMode(name, mode)
        self._bound(connection, name, 0.0)

    def forget(self, name: str) -> None:
        """Drops all that is known of a vehicle, which SUMO is not told."""
        self._modes.pop(name, None)
        self._raised.pop(name, None)

    def bound_braking(
        self, connection: Connection, names: Iterable[str], needed: Mapping[str, float]
    ) -> None:
        """Lets SUMO brake vehicles as hard as they must, and others as their vType says again.

        Those are vehicles of `names`, and all that were given back.

        Args:
            connection: to the simulation.
            names: vehicles whose next speeds are known.
            needed: m/s2, of those of them that must brake harder than comfortably.
        """
        if self._raised:
            settled = self._raised.keys() & set(names)
            settled |= self._given_back(connection)
            for name in settled - needed.keys():
                self._bound(connection, name, 0.0)
        for name, deceleration in needed.items():
            self._bound(connection, name, deceleration)

    def _given_back(self, connection: Connection) -> set[str]:
        """Returns the vehicles with a raised `decel` that are not driven any more."""
        names = self._raised.keys() - self._modes.keys()
        if not names:
            return set()
        present = names & set(connection.vehicle.getIDList())
        for name in names - present:
            del self._raised[name]
        return present

    def _bound(self, connection: Connection, name: str, needed: float) -> None:
        """Sets a vehicle's `decel` to what it needs, m/s2, or to its vType's own."""
        vehicle = connection.vehicle
        raised = self._raised.get(name)
        if raised is None:
            usual = vehicle.getDecel(name)
            if needed <= usual:
                return
            raised = RaisedDecel(vehicle.getTypeID(name), usual, usual)
        wanted = max(needed, raised.usual)
        if wanted < raised.bound and stopping_deceleration(connection, name, wanted) > wanted:
            return
        if wanted > raised.usual:
            self._raised[name] = replace(raised, bound=wanted)
            self._raise(connection, name, raised.vtype, wanted)
            return
        del self._raised[name]
        if vehicle.getTypeID(name) == raised.vtype:
            vehicle.setDecel(name, raised.usual)  # it had a vType of its own before
        else:
            vehicle.setType(name, raised.vtype)

    def _raise(self, connection: Connection, name: str, vtype: str, bound: float) -> None:
        """Sets a vehicle's `decel` above that of its vType, m/s2."""
        loaded = f"{vtype}@{name}"
        if loaded not in self._loaded_types:
            connection.vehicle.setDecel(name, bound)
            return
        if connection.vehicle.getTypeID(name) != loaded:
            connection.vehicle.setType(name, loaded)
        connection.vehicletype.setDecel(loaded, bound)

    def described(self) -> dict[str, Any]:
        """Returns what `go_on` reads, as text and numbers."""
        raised = {name: asdict(decel) for name, decel in self._raised.items()}
        return {"speed_modes": dict(self._modes), "raised": raised}

    def go_on(self, connection: Connection, described: Mapping[str, Any]) -> None:
        """Goes on from a description where SUMO has loaded its state of that instant.

        SUMO's state keeps nothing of TraCI's, and the `decel` of a vType with two decimals.
        """
        self._modes = dict(described["speed_modes"])
        self._raised = {name: RaisedDecel(**decel) for name, decel in described["raised"].items()}
        types = connection.vehicletype.getIDList()
        self._loaded_types = frozenset(vtype for vtype in types if "@" in vtype)
        for name in self._modes:
            connection.vehicle.setSpeedMode(name, self.speed_mode)
        for name, raised in self._raised.items():
            self._raise(connection, name, raised.vtype, raised.bound)
