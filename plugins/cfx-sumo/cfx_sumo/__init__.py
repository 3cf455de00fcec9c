"""cfx in Eclipse SUMO (https://eclipse.dev/sumo): `pip install "cfx-driving[sumo]"`.

    driver = cfx_sumo.Driver.load("outputs/my-job")
    while connection.simulation.getMinExpectedNumber():
        connection.simulationStep()
        driver.step(connection, ["ego", "other"])

`connection` is the module `libsumo`, the module `traci` or one of its connections. Importing this
package imports neither.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfx_sumo.live.driver import Driver as Driver
    from cfx_sumo.live.driver import DriverOptions as DriverOptions
    from cfx_sumo.live.fleet import Fleet as Fleet

_HOMES = {
    "Driver": "cfx_sumo.live.driver",
    "DriverOptions": "cfx_sumo.live.driver",
    "Fleet": "cfx_sumo.live.fleet",
}

__all__ = ["Driver", "DriverOptions", "Fleet"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cfx_sumo' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
