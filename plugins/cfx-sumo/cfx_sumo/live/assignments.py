"""Which network drives which vehicle, and as which driver.

Shapes: D vehicles, n tuned parameters, k driver features.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from cfx.errors import DataError, ParameterError
from cfx.plugin import ANY_DRIVER, Agent, base_of
from cfx_sumo.live.draws import uniform_of_vehicles
from cfx_sumo.live.vehicles import VehicleTable


class Assignments:
    """Keeps what a program says of vehicles before they begin.

    Args:
        policy: whose networks drive.
        network: which of them drives vehicles that nothing is said of; None: none does.
        source: where the policy comes from, for messages.
        seed: of which of the recorded drivers each vehicle has, where nothing is said of it; None:
            all have the average one.

    Raises:
        DataError: the policy has no such network.
    """

    def __init__(
        self, policy: Agent, network: str | None, source: str, seed: int | None = None
    ) -> None:
        self._policy = policy
        self._seed = seed
        self._source = source
        self._default = None
        if network is not None:
            self._default = self._number(network)
        self._networks: dict[str, int] = {}
        self._bases: dict[str, list[float]] = {}
        self._driver_features: dict[str, list[float]] = {}

    def assign(
        self,
        vehicle: str,
        network: str | None,
        base: Mapping[str, float] | None,
        driver_features: Mapping[str, float] | None,
    ) -> None:
        """Says how a vehicle is driven from when it begins; None leaves it as it is.

        Args:
            vehicle: its id.
            network: which of the policy's networks drives it.
            base: calibrated parameters of a driver, name -> SI value.
            driver_features: name -> value.

        Raises:
            DataError: the policy has no such network.
            ParameterError: names that are not those of the policy.
        """
        if network is not None:
            self._networks[vehicle] = self._number(network)
        if base is not None:
            self._bases[vehicle] = self._shrunk_base(base)
        if driver_features is not None:
            self._driver_features[vehicle] = self._ordered_features(driver_features)

    def begin(self, table: VehicleTable, rows: Tensor, names: list[str]) -> None:
        """Puts network, base and driver features of D vehicles into their rows, `(D,)` int64.

        Raises:
            DataError: no network drives one of them.
        """
        table.network[rows] = torch.tensor([self._network_of(name) for name in names])
        if self._policy.base is not None:
            table.base[rows] = self._policy.base[table.network[rows]].to(table.base)
        table.driver_features[rows] = torch.nan
        drivers = self._policy.trained_on.drivers
        if self._seed is not None and drivers is not None:
            table.driver_features[rows] = drivers.drawn(uniform_of_vehicles(self._seed, names))
        for row, name in zip(rows.tolist(), names, strict=True):
            if name in self._bases:
                table.base[row] = torch.tensor(self._bases[name], dtype=torch.float64)
            if name in self._driver_features:
                features = torch.tensor(self._driver_features[name], dtype=torch.float64)
                table.driver_features[row] = features

    def forget(self, vehicle: str) -> None:
        """Drops what was said of a vehicle."""
        self._networks.pop(vehicle, None)
        self._bases.pop(vehicle, None)
        self._driver_features.pop(vehicle, None)

    def described(self) -> dict[str, Any]:
        """Returns what `go_on` reads, as text and numbers."""
        return {
            "assigned": self._networks,
            "bases": self._bases,
            "driver_features": self._driver_features,
        }

    def go_on(self, described: Mapping[str, Any]) -> None:
        """Goes on from a description."""
        self._networks = dict(described["assigned"])
        self._bases = dict(described["bases"])
        self._driver_features = dict(described["driver_features"])

    def _number(self, network: str) -> int:
        names = self._policy.names
        if network in names:
            return names.index(network)
        if network == ANY_DRIVER and len(names) == 1:
            return 0
        if network == ANY_DRIVER:
            raise DataError(
                f"{self._source} has {len(names)} networks, each for one driver ({names[0]}, ...),"
                " and none for unseen drivers; train with protocol.networks=all or"
                " protocol=across_drivers, or name one of them: Driver.load(..., network=...), or"
                f" --drivers TYPE={self._source}#{names[0]}"
            )
        listed = ", ".join(names[:5])
        if len(names) > 5:
            listed += ", ..."
        raise DataError(f"{self._source} has no network '{network}'; it has {listed}")

    def _network_of(self, vehicle: str) -> int:
        """Returns the number of the network that drives a vehicle."""
        number = self._networks.get(vehicle, self._default)
        if number is None:
            raise DataError(
                f"no network of {self._source} was assigned to vehicle '{vehicle}'; call"
                " assign(vehicle, network) first"
            )
        return number

    def _shrunk_base(self, base: Mapping[str, float]) -> list[float]:
        names = self._policy.core.head.model_space.names
        if set(base) != set(names):
            raise ParameterError(
                f"base: give a value for each of {', '.join(names)}, and nothing else"
            )
        calibrated = torch.tensor([[base[name] for name in names]], dtype=torch.float64)
        shrunk: list[float] = base_of(self._policy, calibrated)[0].tolist()
        return shrunk

    def _ordered_features(self, driver_features: Mapping[str, float]) -> list[float]:
        names = self._policy.core.driver_features
        if not names:
            raise ParameterError(
                "driver_features: this policy was trained to read none; leave them out"
            )
        if set(driver_features) != set(names):
            raise ParameterError(
                f"driver_features: give a value for each of {', '.join(names)}, and nothing else"
            )
        return [driver_features[name] for name in names]
