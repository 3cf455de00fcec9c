"""What a SUMO process does: it simulates followers behind leaders, one request after the other.

It is a process of its own, because libsumo holds one simulation in a process and does not get on
with pyarrow, which jobs load. A request loads the network of parallel roads anew in the running
libsumo (0.1 ms for each road). So an answer depends on its request alone, random draws included,
and any attribute of a vType may differ between requests, which SUMO does not let change while it
runs.

This module imports neither torch nor SUMO.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfx.errors import SumoError
from cfx.plugin import distributions
from cfx_sumo.installed import DISTRIBUTION
from cfx_sumo.simulation.network import FOLLOWER, LANE, LEADER, ROAD, Placed, network, routes

Array = NDArray[np.float64]

LOG = "sumo.log"
"""File in a process's folder that takes what SUMO prints."""

_BEHIND = 100.0  # m from a road's begin to whatever is furthest behind

_OPTIONS = {
    "--collision.action": "none",
    "--time-to-teleport": "-1",
    "--no-step-log": "true",
    "--duration-log.disable": "true",
}


_ROADS: list[Roads] = []
"""The simulation of this process."""


class Request(NamedTuple):
    """n followers behind n leaders for K steps. SI units.

    Attributes:
        header: `dt`, `seed`, `car_follow_model`, `constants` and `leader_constants` (vType
            attributes of all), `names` and `leader_names` (those that differ).
        arrays: `attributes` `(n, names)`, `leader_attributes`, `start` `(3, n)` (position, speed,
            acceleration of the followers), and `leader_position`, `leader_speed`,
            `leader_acceleration` `(K, n)`, frames 0 to K - 1.
    """

    header: dict[str, Any]
    arrays: dict[str, Array]


class Answer(NamedTuple):
    """Positions and speeds of a request's followers.

    Attributes:
        number: of the request.
        position, speed: `(K, n)`, frames 1 to K.
    """

    number: int
    position: Array
    speed: Array


class Roads:
    """Parallel roads in the one simulation that a process has.

    Args:
        folder: where SUMO's input is written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running = False

    @cached_property
    def _sumo(self) -> Any:
        import libsumo

        return libsumo

    def printed(self) -> str:
        """Returns what SUMO has printed since the request came."""
        return (self._folder / LOG).read_text(encoding="utf-8", errors="replace")

    def simulate(self, request: Request) -> tuple[Array, Array]:
        """Simulates all followers of a request at once; returns positions and speeds `(K, n)`.

        Raises:
            libsumo.TraCIException: SUMO refuses the input, or a vehicle is gone.
        """
        header, arrays = request
        leader, start = arrays["leader_position"], arrays["start"]
        origin = np.minimum(leader.min(axis=0), start[0]) - _BEHIND
        self._load(request, origin)
        position, speed = self._steps(arrays, leader - origin, float(header["dt"]))
        return position + origin, speed

    def _load(self, request: Request, origin: Array) -> None:
        """Puts all vehicles where they start."""
        header, arrays = request
        attributes = _attributes(header["constants"], header["names"], arrays["attributes"])
        ahead = _attributes(
            header["leader_constants"], header["leader_names"], arrays["leader_attributes"]
        )
        position = (arrays["start"][0] - origin).tolist()
        leader_position = (arrays["leader_position"][0] - origin).tolist()
        speed, leader_speed = arrays["start"][1].tolist(), arrays["leader_speed"][0].tolist()
        count = len(attributes)
        leaders, followers = [], []
        for i in range(count):
            attributes[i]["carFollowModel"] = header["car_follow_model"]
            leaders.append(Placed(ahead[i], leader_position[i], leader_speed[i]))
            followers.append(Placed(attributes[i], position[i], speed[i]))
        net = self._folder / f"{count}.net.xml"
        if not net.exists():
            net.write_text(network(count))
        route_file = self._folder / "drive.rou.xml"
        route_file.write_text(routes(leaders, followers))
        options = {
            "-n": str(net),
            "-r": str(route_file),
            "--step-length": repr(header["dt"]),
            "--seed": str(header["seed"]),
            "--thread-rngs": str(count),  # each road draws from numbers of its own
            **_OPTIONS,
        }
        self._start(options)

    def _start(self, options: Mapping[str, str]) -> None:
        words = []
        for name, value in options.items():
            words += [name, value]
        if self._running:
            self._sumo.load(words)
        else:
            self._sumo.start(["sumo", *words])
            self._running = True

    def _steps(
        self, arrays: Mapping[str, Array], leader_position: Array, dt: float
    ) -> tuple[Array, Array]:
        """Takes all steps; returns positions on the road and speeds `(K, n)`.

        The leader's speed moves it to its next position. Then its speed and acceleration are put
        right, as recorded positions are rarely the sums of recorded speeds. SUMO drives no vehicle
        backwards, so that is a jump.
        """
        vehicle, step = self._sumo.vehicle, self._sumo.simulationStep
        steps, count = leader_position.shape
        leaders = [LEADER.format(i) for i in range(count)]
        followers = [FOLLOWER.format(i) for i in range(count)]
        needed = (np.diff(leader_position, axis=0) / dt).tolist()
        place = leader_position.tolist()
        speeds = arrays["leader_speed"].tolist()
        accelerations = arrays["leader_acceleration"].tolist()
        step()
        for i, (leader, follower) in enumerate(zip(leaders, followers, strict=True)):
            vehicle.setLaneChangeMode(leader, 0)
            vehicle.setLaneChangeMode(follower, 0)
            vehicle.setSpeedMode(leader, 0)
            vehicle.setPreviousSpeed(leader, speeds[0][i], accelerations[0][i])
            vehicle.setPreviousSpeed(follower, *arrays["start"][1:, i].tolist())
        position, speed = np.empty((steps, count)), np.empty((steps, count))
        for k in range(steps):
            last = k == steps - 1  # the leader is not seen any more
            if not last:
                for leader, wanted in zip(leaders, needed[k], strict=True):
                    vehicle.setSpeed(leader, max(wanted, 0.0))
            step()
            if not last:
                for i, leader in enumerate(leaders):
                    if needed[k][i] < 0.0:
                        vehicle.moveTo(leader, LANE.format(i), place[k + 1][i])
                    vehicle.setPreviousSpeed(leader, speeds[k + 1][i], accelerations[k + 1][i])
            position[k] = [vehicle.getLanePosition(follower) for follower in followers]
            speed[k] = [vehicle.getSpeed(follower) for follower in followers]
        return position, speed


def _attributes(
    constants: Mapping[str, str], names: list[str], values: Array
) -> list[dict[str, float | str]]:
    """Returns the attributes of each vehicle."""
    vehicles = []
    for row in values.tolist():
        attributes: dict[str, float | str] = dict(constants)
        attributes.update(zip(names, row, strict=True))
        vehicles.append(attributes)
    return vehicles


def begin(folder: Path) -> None:
    """Prepares this process, which has a folder of its own inside `folder`."""
    place = folder / str(os.getpid())
    place.mkdir()
    # What SUMO prints says why it refuses something.
    log = os.open(place / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(log, 1)
    os.dup2(log, 2)
    _ROADS[:] = [Roads(place)]


def answer(number: int, request: Request) -> Answer:
    """Simulates all followers of a request.

    Raises:
        SumoError: SUMO refuses it, lost a vehicle, or cannot be loaded.
    """
    os.ftruncate(1, 0)
    try:
        return Answer(number, *_ROADS[0].simulate(request))
    except ImportError as error:
        raise SumoError(
            f"SUMO cannot be loaded ({error}): {distributions.install_line(DISTRIBUTION)}"
        ) from None
    except Exception as error:  # libsumo's errors have no common base
        if not type(error).__module__.startswith("libsumo"):
            raise
        raise SumoError(_in_words(str(error), _ROADS[0].printed())) from None


def _in_words(error: str, log: str) -> str:
    """Joins the error that libsumo raised and what SUMO printed beside it.

    Only the two together say what is wrong.
    """
    first = error.strip().rstrip(".")
    if "is not known" in error:
        return (
            f"SUMO lost a vehicle ({first}): it left the {ROAD / 1000:.0f} km of its road; look for"
            " positions far out in the data, and for bounds of parameters that mean nothing"
        )
    return f"SUMO refuses the vehicles: {': '.join([first, *printed_errors(log)])}"


def printed_errors(log: str) -> list[str]:
    """Returns the errors among the lines that SUMO has printed, each once."""
    errors: dict[str, None] = {}
    for line in log.splitlines():
        if line.startswith("Error:"):
            errors[line.removeprefix("Error:").strip().rstrip(".")] = None
    return list(errors)


def printed_here() -> str:
    """Returns what SUMO has printed in this process since its last request came."""
    return _ROADS[0].printed()
