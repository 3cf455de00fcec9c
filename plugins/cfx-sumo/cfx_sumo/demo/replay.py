"""Recorded leaders in SUMO with a real follower and live drivers behind each.

`cfx_sumo.demo.simulated` has a SUMO process call `replay`: a process of its own, because libsumo
does not get on with pyarrow, which jobs load. This module imports neither torch nor SUMO.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfx.errors import SumoError
from cfx_sumo.simulation.worker import Array, printed_errors, printed_here

FOLLOWERS = ("real", "policy", "default")
"""What drives behind a copy of the same leader: the recording, the job's policy, the model's
default parameters."""

CAR_LENGTH = 4.5
"""m: followers' lengths stand in no recording of pairs, and change nothing."""

LOOK_AHEAD = 1e4
"""m: a vehicle that falls far behind still follows its leader, as in memory."""

_OPTIONS = (
    *("--collision.action", "none"),
    *("--time-to-teleport", "-1"),
    *("--no-step-log", "true"),
    *("--duration-log.disable", "true"),
    *("--no-warnings", "true"),
)


class ReplayRequest(NamedTuple):
    """What is simulated; SI units. Pairs of one scene are on the road together.

    Attributes:
        header: `dt`, `net`, `edges`, `tracks` (as in `Motorway`), `policy` (a folder), and `pairs`,
            each with its `scene`, `length` (of the leader, m), `first` (frame at which the drivers
            take over), `network`, `base` (parameters that offsets start from, or None),
            `driver_features` (of the driver, or None), `renew` (frame at which the policy's memory
            begins), and for each of `FOLLOWERS` its `track` and `places` (edge and position on it
            of leader and follower at frame 0).
        arrays: `I/leader` and `I/follower` `(3, T)` of pair I: position, speed, acceleration.
    """

    header: dict[str, Any]
    arrays: dict[str, Array]


class Recorded:
    """A vehicle that drives exactly as it was recorded.

    SUMO moves it from where it is to its next position. Then its speed and acceleration are
    corrected, as recorded positions are rarely the sums of recorded speeds. SUMO drives no vehicle
    backwards, so that is a jump.
    """

    def __init__(self, name: str, signals: Array) -> None:
        """Takes `(3, T)`: position, speed, acceleration."""
        self.name = name
        self.position, self.speed, self.acceleration = signals.tolist()
        self._jumps = 0.0
        self._start = self.position[0]

    def now(self, sumo: Any) -> float:
        """Returns the position, m, in the recording's terms."""
        return float(self._start + sumo.vehicle.getDistance(self.name) + self._jumps)

    def aim(self, sumo: Any, frame: int) -> None:
        """Says before a step where to be after it."""
        ahead = self.position[frame] - self.now(sumo)
        sumo.vehicle.setSpeed(self.name, max(0.0, ahead / sumo.simulation.getDeltaT()))

    def settle(self, sumo: Any, frame: int) -> None:
        """Corrects speed and acceleration after a step."""
        back = self.position[frame] - self.now(sumo)
        if back < -1e-9:
            lane = sumo.vehicle.getLaneID(self.name)
            place = sumo.vehicle.getLanePosition(self.name) + back
            sumo.vehicle.moveTo(self.name, lane, max(0.0, place))
            self._jumps += back
        sumo.vehicle.setPreviousSpeed(self.name, self.speed[frame], self.acceleration[frame])


class Road:
    """One follower of one pair behind its copy of the leader."""

    def __init__(
        self, number: int, kind: str, pair: Mapping[str, Any], arrays: Mapping[str, Array]
    ) -> None:
        self.number, self.kind, self.pair = number, kind, pair
        self.leader = Recorded(f"{number}/leader/{kind}", arrays[f"{number}/leader"])
        self.follower = Recorded(f"{number}/{kind}", arrays[f"{number}/follower"])
        self.frames = len(self.leader.position)
        self.motion: Array = np.full((self.frames, 2), np.nan)
        self.place: Array = np.full((self.frames, 2, 3), np.nan)

    def replayed(self, frame: int) -> bool:
        """Whether the follower, too, is replayed at a frame."""
        return self.kind == "real" or frame <= self.pair["first"]

    def settle(self, sumo: Any, frame: int) -> None:
        """After a step: corrects what is replayed, and notes where both vehicles are."""
        self.leader.settle(sumo, frame)
        if self.replayed(frame):
            self.follower.settle(sumo, frame)
        speed = sumo.vehicle.getSpeed(self.follower.name)
        gap = self.leader.now(sumo) - self.pair["length"] - self.follower.now(sumo)
        self.motion[frame] = (speed, gap)
        for k, vehicle in enumerate((self.leader.name, self.follower.name)):
            x, y = sumo.vehicle.getPosition(vehicle)
            self.place[frame, k] = (x, y, sumo.vehicle.getAngle(vehicle))

    def aim(self, sumo: Any, frame: int) -> None:
        """Before a step: says where replayed vehicles shall be at `frame`."""
        self.leader.aim(sumo, frame)
        if self.replayed(frame):
            self.follower.aim(sumo, frame)


def replay(request: ReplayRequest) -> dict[str, Array]:
    """Simulates all scenes, one after another, in a process that is SUMO's.

    Returns:
        For pair I and each F of `FOLLOWERS` the arrays `I/F/motion` `(T, 2)` (speed, gap to the
        leader ahead) and `I/F/place` `(T, 2, 3)` (x, y and heading in degrees of leader and
        follower); `I/parameters` `(T, n)` of the policy, NaN where it does not drive.

    Raises:
        CfxError: the policy cannot drive, or SUMO lost a vehicle.
    """
    # pandas loads pyarrow where it finds it; None is Python's own way to say that it is not there.
    sys.modules["pyarrow"] = None  # type: ignore[assignment]
    os.environ["LIBSUMO_AS_TRACI"] = "quiet"
    try:
        return _replay(request)
    except Exception as error:  # libsumo's errors have no common base
        if not type(error).__module__.startswith("libsumo"):
            raise
        lost = f"SUMO lost a vehicle or refuses one ({error})"
        said = ": ".join([lost, *printed_errors(printed_here())])
        raise SumoError(" ".join(said.split())) from None


def _replay(request: ReplayRequest) -> dict[str, Array]:
    import libsumo

    header, arrays = request
    scenes: dict[int, list[int]] = {}
    for number, pair in enumerate(header["pairs"]):
        scenes.setdefault(pair["scene"], []).append(number)
    answers: dict[str, Array] = {}
    for scene in sorted(scenes):
        answers |= _scene(libsumo, header, scenes[scene], arrays)
    return answers


def _scene(
    sumo: Any, header: Mapping[str, Any], numbers: Sequence[int], arrays: Mapping[str, Array]
) -> dict[str, Array]:
    """Simulates the pairs of one scene."""
    from cfx_sumo.live.driver import Driver

    # Speed mode 0: these trajectories are those of the closed loop in memory, to the last bits.
    policy = Driver.load(
        header["policy"], network=None, look_ahead=LOOK_AHEAD, speed_mode=0, seed=None
    )
    default = Driver.constant(policy.model, dt=header["dt"], look_ahead=LOOK_AHEAD, speed_mode=0)
    drivers = {"policy": policy, "default": default}
    roads = []
    chosen = {}
    for number in numbers:
        pair = header["pairs"][number]
        for kind in FOLLOWERS:
            roads.append(Road(number, kind, pair, arrays))
        frames = len(arrays[f"{number}/leader"][0])
        chosen[number] = np.full((frames, len(policy.policy.core.head.model_space)), np.nan)
        policy.assign(
            f"{number}/policy",
            pair["network"],
            base=pair["base"],
            driver_features=pair["driver_features"],
        )
    _simulate(sumo, header, roads, drivers, chosen)
    answers: dict[str, Array] = {}
    for road in roads:
        answers[f"{road.number}/{road.kind}/motion"] = road.motion
        answers[f"{road.number}/{road.kind}/place"] = road.place
    for number, parameters in chosen.items():
        answers[f"{number}/parameters"] = parameters
    return answers


def _simulate(
    sumo: Any,
    header: Mapping[str, Any],
    roads: Sequence[Road],
    drivers: Mapping[str, Any],
    chosen: Mapping[int, Array],
) -> None:
    """Runs SUMO until the longest recording ends."""
    with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as folder:
        routes = Path(folder, "scene.rou.xml")
        routes.write_text(_routes(header, roads), encoding="utf-8")
        files = ("-n", header["net"], "-r", str(routes))
        sumo.start(["sumo", *files, "--step-length", repr(header["dt"]), *_OPTIONS])
        try:
            for frame in range(max(road.frames for road in roads)):
                sumo.simulationStep()
                present = [road for road in roads if frame < road.frames]
                _frame(sumo, present, frame, drivers, chosen)
        finally:
            sumo.close()


def _frame(
    sumo: Any,
    roads: Sequence[Road],
    frame: int,
    drivers: Mapping[str, Any],
    chosen: Mapping[int, Array],
) -> None:
    """One instant: notes what is, and says what shall be at the next frame."""
    for road in roads:
        if frame == 0:
            for vehicle in (road.leader.name, road.follower.name):
                sumo.vehicle.setLaneChangeMode(vehicle, 0)
                sumo.vehicle.setSpeedMode(vehicle, 0)
        road.settle(sumo, frame)
    for kind, driver in drivers.items():
        _step_driver(sumo, driver, [road for road in roads if road.kind == kind], frame)
    for road in roads:
        if road.kind == "policy" and frame >= road.pair["first"]:
            parameters = drivers["policy"].parameters(road.follower.name)
            of_model = list(parameters.values())[: chosen[road.number].shape[1]]
            chosen[road.number][frame] = of_model or np.nan
        if frame + 1 < road.frames:
            road.aim(sumo, frame + 1)
        else:
            sumo.vehicle.remove(road.leader.name)
            sumo.vehicle.remove(road.follower.name)


def _step_driver(sumo: Any, driver: Any, roads: Sequence[Road], frame: int) -> None:
    """Lets a driver watch the vehicles that are still replayed, and drive the others."""
    watched = []
    driven = []
    for road in roads:
        name = road.follower.name
        if frame == road.pair["renew"] > 0:
            driver.renew(name)
        if frame < road.pair["first"]:
            watched.append(name)
        else:
            driven.append(name)
    driver.step(sumo, watched, drive=False)
    driver.step(sumo, driven)


def _routes(header: Mapping[str, Any], roads: Sequence[Road]) -> str:
    """Returns SUMO's route file: all vehicles at frame 0, under no limit but what drives them."""
    free = 'minGap="0" maxSpeed="130" speedFactor="100" speedDev="0" sigma="0"'
    edges = header["edges"]
    lines = ["<routes>"]
    for number in range(len(edges)):
        lines.append(f'<route id="from{number}" edges="{" ".join(edges[number:])}"/>')
    for road in roads:
        lanes = header["tracks"][road.pair["track"][road.kind]]
        lengths = (road.pair["length"], CAR_LENGTH)
        places = road.pair["places"][road.kind]
        vehicles = (road.leader, road.follower)
        for vehicle, length, (edge, at) in zip(vehicles, lengths, places, strict=True):
            speed = max(0.0, vehicle.speed[0])
            lines.append(f'<vType id="type/{vehicle.name}" length="{length!r}" {free}/>')
            lines.append(
                f'<vehicle id="{vehicle.name}" type="type/{vehicle.name}" route="from{edge}"'
                f' depart="0" insertionChecks="none" departLane="{lanes[edge]}"'
                f' departPos="{at!r}" departSpeed="{speed!r}"/>'
            )
    lines.append("</routes>")
    return "\n".join(lines)
