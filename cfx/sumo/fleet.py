"""Several kinds of drivers in one scenario: a policy for each vType."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cfx.agents.placement import ALL
from cfx.errors import DataError
from cfx.sumo.driver import Connection, Driver


class Fleet:
    """Drives all vehicles of some vTypes, each type by its own driver.

        fleet = Fleet.load({"calm": "outputs/conservative", "hasty": "outputs/aggressive"})
        connection.simulationStep()
        fleet.step(connection)

    Vehicles that come and go are found by themselves. A vehicle belongs to the vType with which it is first seen; a vType that
    SUMO made of it for this one vehicle (`calm@vehicle`) counts as `calm`. Types that share a driver are one batch.
    """

    def __init__(self, drivers: Mapping[str, Driver]) -> None:
        """Takes a driver for each vType.

        Raises:
            DataError: there is none, or their time steps differ.
        """
        if not drivers:
            raise DataError("a fleet needs a driver for at least one vType")
        steps = {name: driver.policy.dt for name, driver in drivers.items()}
        if max(steps.values()) - min(steps.values()) > 1e-6:
            listed = ", ".join(f"{name} {dt:g} s" for name, dt in steps.items())
            raise DataError(
                f"the policies were trained at different time steps ({listed}); a simulation has one"
            )
        self.drivers = dict(drivers)
        self._type_of: dict[str, str] = {}

    @classmethod
    def load(
        cls,
        runs: Mapping[str, str | Path],
        *,
        network: str = ALL,
        look_ahead: float = 200.0,
        speed_mode: int = 0,
    ) -> Fleet:
        """Reads the policy of a run for each vType; types with the same run share a driver. See `Driver.load`."""
        loaded = {
            run: Driver.load(run, network=network, look_ahead=look_ahead, speed_mode=speed_mode)
            for run in dict.fromkeys(runs.values())
        }
        return cls({name: loaded[run] for name, run in runs.items()})

    @property
    def vehicles(self) -> dict[str, str]:
        """The vType of each vehicle of the fleet that was on the road at the last step."""
        return {vehicle: name for vehicle, name in self._type_of.items() if name in self.drivers}

    def step(self, connection: Connection) -> None:
        """Sets the speeds that the fleet's vehicles will drive in the next `simulationStep`; call it after each.

        Raises:
            SumoError: the simulation's step is not the policies'.
        """
        present = connection.vehicle.getIDList()
        kind = connection.vehicle.getTypeID
        self._type_of = {
            one: self._type_of.get(one) or kind(one).partition("@")[0] for one in present
        }
        members: dict[int, list[str]] = {id(driver): [] for driver in self.drivers.values()}
        for vehicle, name in self._type_of.items():
            if name in self.drivers:
                members[id(self.drivers[name])].append(vehicle)
        for driver in {id(driver): driver for driver in self.drivers.values()}.values():
            driver.step(connection, members[id(driver)])

    def driver(self, vehicle: str) -> Driver:
        """Returns who drives a vehicle of the fleet."""
        return self.drivers[self._type_of[vehicle]]
