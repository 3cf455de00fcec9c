"""A SUMO process: `python -m cfx.simulators.sumo.worker FOLDER`.

It simulates followers behind leaders, one request after the other. It is a process of its own,
because libsumo holds one simulation in a process and does not get on with pyarrow, which jobs load.
It ends when its standard input does, and so with its job, however that ends. A request loads the
network of parallel roads anew in the running libsumo (0.1 ms for each road). So an answer depends
on its request alone, random draws included, and any attribute of a vType may differ between
requests, which SUMO does not let change while it runs.

Request: header `dt`, `seed`, `car_follow_model`, `constants` and `leader_constants` (vType
attributes of all), `names` and `leader_names` (those that differ); arrays `attributes` `(n,
names)`, `leader_attributes`, `start` `(3, n)` (position, speed, acceleration of the followers), and
`leader_position`, `leader_speed`, `leader_acceleration` `(K, n)`, frames 0 to K - 1.

Answer: arrays `position` and `speed` `(K, n)`, frames 1 to K; or a header with `error`. SI units.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cfx.simulators.sumo.channel import Array, Message, receive, send
from cfx.simulators.sumo.network import FOLLOWER, LANE, LEADER, Placed, network, routes

LOG = "sumo.log"
"""File in the folder that takes what SUMO prints."""

_BEHIND = 100.0  # m from a road's begin to whatever is furthest behind

_OPTIONS = {
    "--collision.action": "none",
    "--time-to-teleport": "-1",
    "--no-step-log": "true",
    "--duration-log.disable": "true",
}


class Roads:
    """The simulation of this process.

    Args:
        folder: where SUMO's input is written.
    """

    def __init__(self, folder: Path) -> None:
        import libsumo

        self._sumo: Any = libsumo
        self._folder = folder
        self._running = False

    def simulate(self, request: Message) -> dict[str, Array]:
        """Simulates all followers of a request at once.

        Raises:
            libsumo.TraCIException: SUMO refuses the input, or a vehicle is gone.
        """
        header, arrays = request
        leader, start = arrays["leader_position"], arrays["start"]
        origin = np.minimum(leader.min(axis=0), start[0]) - _BEHIND
        self._load(request, origin)
        position, speed = self._steps(arrays, leader - origin, float(header["dt"]))
        return {"position": position + origin, "speed": speed}

    def _load(self, request: Message, origin: Array) -> None:
        """Puts all vehicles where they start."""
        header, arrays = request
        own = _attributes(header["constants"], header["names"], arrays["attributes"])
        ahead = _attributes(
            header["leader_constants"], header["leader_names"], arrays["leader_attributes"]
        )
        position = (arrays["start"][0] - origin).tolist()
        leader_position = (arrays["leader_position"][0] - origin).tolist()
        speed, leader_speed = arrays["start"][1].tolist(), arrays["leader_speed"][0].tolist()
        count = len(own)
        leaders, followers = [], []
        for i in range(count):
            own[i]["carFollowModel"] = header["car_follow_model"]
            leaders.append(Placed(ahead[i], leader_position[i], leader_speed[i]))
            followers.append(Placed(own[i], position[i], speed[i]))
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


def main(folder: Path) -> None:
    """Answers requests from standard input until it ends."""
    # Ctrl-C is for the job, which then lets go of this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # SUMO prints to both standard outputs, and the answers must stay clean.
    answers = os.fdopen(os.dup(1), "wb")
    log = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    os.dup2(log, 1)
    os.dup2(log, 2)
    try:
        roads = Roads(folder)
        while (request := receive(sys.stdin.buffer)) is not None:
            os.ftruncate(log, 0)
            try:
                done = roads.simulate(request)
            except Exception as error:  # libsumo's errors have no common base
                send(answers, {"error": _told(error)})
            else:
                send(answers, {}, done)
    except BrokenPipeError:
        pass  # the job ended in the middle of an answer
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _told(error: Exception) -> str:
    """Returns an error's text; that of one that is not SUMO's begins with its type."""
    if type(error).__module__.startswith("libsumo"):
        return str(error)
    return f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
