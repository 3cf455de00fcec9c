"""The file of `cfx drive --output`: where each driven vehicle is at each step."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from cfx.errors import OutputError
from cfx.plugin import files
from cfx_sumo.live.fleet import Fleet

_DECIMALS = 6
"""Of the numbers: micrometres, however far a vehicle is from the origin."""


class VehicleRows:
    """Writes a row for each vehicle of the fleet and step, SI units."""

    _COLUMNS = (
        "time_s",
        "vehicle",
        "type",
        "edge",
        "lane",
        "position_m",
        "x_m",
        "y_m",
        "speed_mps",
        "acceleration_mps2",
    )

    def __init__(self, file: TextIO, parameters: Sequence[str]) -> None:
        self._writer = csv.writer(file)
        self._parameters = list(parameters)
        self._writer.writerow([*self._COLUMNS, *(f"parameter_{name}" for name in parameters)])

    @classmethod
    def opened(cls, stack: ExitStack, path: Path, fleet: Fleet) -> VehicleRows:
        """Opens the file, which takes its name when the run has ended well."""
        if path.is_dir():
            raise OutputError(f"{path} is a folder; name a file in --output")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = stack.enter_context(files.atomic_write(path))
            file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({error.strerror}); name another --output"
            ) from error
        names: dict[str, None] = {}
        for driver in fleet.drivers.values():
            names |= dict.fromkeys(driver.policy.space.names)
        return cls(file, list(names))

    def write(self, sumo: Any, fleet: Fleet) -> None:
        """Writes where the fleet's vehicles are, and the parameters with which they drive on."""
        for name, kind in fleet.vehicles.items():
            self._writer.writerow(self._row(sumo, name, kind, fleet.drivers[kind].parameters(name)))

    def _row(self, sumo: Any, name: str, kind: str, parameters: Mapping[str, float]) -> list[str]:
        vehicle = sumo.vehicle
        lane = [vehicle.getRoadID(name), str(vehicle.getLaneIndex(name))]
        x, y = vehicle.getPosition(name)
        speed, acceleration = vehicle.getSpeed(name), vehicle.getAcceleration(name)
        row = [f"{sumo.simulation.getTime():.10g}", name, kind, *lane]
        for value in (vehicle.getLanePosition(name), x, y, speed, acceleration):
            row.append(repr(round(value, _DECIMALS)))
        for parameter in self._parameters:
            value = parameters.get(parameter)
            row.append("" if value is None else repr(round(value, _DECIMALS)))
        return row
