"""Several kinds of drivers in one scenario: a policy for each vType."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Unpack

import torch

from cfx.errors import DataError
from cfx.plugin import ANY_DRIVER, threads
from cfx_sumo.live.driver import Driver, DriverOptions, Together
from cfx_sumo.live.saved import read_state, write_state
from cfx_sumo.live.surroundings import Connection

_DONE = object()


class Fleet:
    """Drives all vehicles of some vTypes, each type by its own driver.

        fleet = Fleet.load({"calm": "outputs/conservative", "hasty": "outputs/aggressive"})
        connection.simulationStep()
        fleet.step(connection)

    The fleet finds vehicles that come and go. A vehicle belongs to the vType with which it is first
    seen; a vType that SUMO made of it for this one vehicle (`calm@vehicle`) counts as `calm`. Types
    that share a driver are one batch.
    """

    def __init__(self, drivers: Mapping[str, Driver]) -> None:
        """Takes a driver for each vType.

        Raises:
            DataError: there is none.
        """
        if not drivers:
            raise DataError("a fleet needs a driver for at least one vType")
        self.drivers = dict(drivers)
        self._type_of: dict[str, str] = {}
        self._ids: tuple[str, ...] | None = None
        self._driven: dict[str, str] | None = None
        self._vehicles_of: dict[int, list[str]] = {}
        self._member_of: dict[str, str] = {}

    def add_members(self, name: str, vtypes: Iterable[str]) -> None:
        """Lets vehicles of further vTypes count as those of a name that the fleet has.

        Args:
            name: one of `drivers`, as of a vTypeDistribution.
            vtypes: its members.
        """
        for vtype in vtypes:
            self._member_of[vtype] = name
        self._ids = None

    @classmethod
    def load(
        cls,
        runs: Mapping[str, str | Path],
        *,
        network: str = ANY_DRIVER,
        **options: Unpack[DriverOptions],
    ) -> Fleet:
        """Reads the policy of a run for each vType; types with the same run share a driver.

        A run may be followed by `#` and the name of one of its networks, which drives then. Each
        driver has a seed of its own, from `seed` on. The other arguments are those of
        `Driver.load`.
        """
        seed = options.get("seed", 0)
        loaded: dict[str | Path, Driver] = {}
        for run in dict.fromkeys(runs.values()):
            folder, chosen = _network_of(run, network)
            of_driver = options.copy()
            of_driver["seed"] = None if seed is None else seed + len(loaded)
            loaded[run] = Driver.load(folder, network=chosen, **of_driver)
        return cls({name: loaded[run] for name, run in runs.items()})

    @property
    def vehicles(self) -> dict[str, str]:
        """The vType of each vehicle of the fleet that was on the road at the last step."""
        if self._driven is None:
            types = self._type_of.items()
            self._driven = {vehicle: name for vehicle, name in types if name in self.drivers}
        return self._driven

    @torch.no_grad()
    @threads.one_thread()
    def step(self, connection: Connection) -> None:
        """Sets the speeds of the fleet's vehicles in the next `simulationStep`.

        Call it after each.

        Raises:
            SumoError: as `Driver.step` does.
        """
        departed = connection.simulation.getDepartedIDList()
        ids = connection.vehicle.getIDList()
        # Mostly the same vehicles are on the road as at the last step.
        if departed or ids != self._ids:
            self._sort(connection, ids, set(departed))
        vehicles = self._vehicles_of
        together: Together | None = {} if len(vehicles) > 1 else None
        turns = [
            driver.in_turns(connection, vehicles[id(driver)], together)
            for driver in self._each_driver()
        ]
        while turns:
            turns = [turn for turn in turns if next(turn, _DONE) is not _DONE]

    def _sort(
        self, connection: Connection, ids: tuple[str, ...], departed: Collection[str]
    ) -> None:
        """Finds the vType and the driver of each vehicle on the road."""
        types: dict[str, str] = {}
        for vehicle in ids:
            name = self._type_of.get(vehicle)
            if name is None or vehicle in departed:
                name = self._name_of(connection.vehicle.getTypeID(vehicle))
            types[vehicle] = name
        self._ids, self._type_of = ids, types
        self._driven = None
        vehicles: dict[int, list[str]] = {id(driver): [] for driver in self._each_driver()}
        for vehicle, name in types.items():
            if name in self.drivers:
                vehicles[id(self.drivers[name])].append(vehicle)
        self._vehicles_of = vehicles

    def has_type(self, vtype: str) -> bool:
        """Says whether the fleet drives vehicles of a vType of SUMO's."""
        return self._name_of(vtype) in self.drivers

    def _name_of(self, vtype: str) -> str:
        """Returns the name under which a vType of SUMO's counts."""
        shared = vtype.partition("@")[0]
        return self._member_of.get(shared, shared)

    def save_state(self, path: str | Path) -> None:
        """Writes what all drivers know, as `Driver.save_state` does.

        Raises:
            OutputError: the file cannot be written.
        """
        write_state(Path(path), [driver.record() for driver in self._each_driver()], self._type_of)

    def load_state(self, connection: Connection, path: str | Path) -> None:
        """Goes on from what `save_state` wrote, as `Driver.load_state` does.

        Raises:
            DataError: there is no such file, or it is of another fleet.
            SumoError: the simulation is at another time, or lacks one of the vehicles.
        """
        records, types = read_state(Path(path))
        drivers = self._each_driver()
        if len(records) != len(drivers):
            raise DataError(
                f"{path} holds the state of {len(records)} drivers, this fleet has {len(drivers)};"
                " load it with the fleet that it was saved with"
            )
        for driver, record in zip(drivers, records, strict=True):
            driver.go_on(connection, record, str(path))
        self._type_of, self._ids, self._driven = types, None, None

    def _each_driver(self) -> list[Driver]:
        """Returns each driver once, in the order of their types."""
        return list({id(driver): driver for driver in self.drivers.values()}.values())

    def driver(self, vehicle: str) -> Driver:
        """Returns the driver of a vehicle of the fleet."""
        return self.drivers[self._type_of[vehicle]]


def _network_of(run: str | Path, network: str) -> tuple[str | Path, str]:
    """Splits `RUN#NETWORK`; a folder of such a name is taken as it is."""
    text = str(run)
    if "#" not in text or Path(text).exists():
        return run, network
    folder, _, chosen = text.rpartition("#")
    return folder, chosen
