"""Recorded leaders in SUMO, and behind each a real follower and live drivers: `python -m cfx.sumo.replay`.

It is a process of its own, because libsumo does not get on with pyarrow, which jobs load; it answers one request from standard
input and ends. `cfx.sumo.demo` asks.

Request: header `dt`, `net`, `edges`, `tracks` (as in `Motorway`), `policy` (a folder), and `pairs`, each with its `scene`,
`length` (of the leader, m), `first` (frame at which the drivers take over), `network`, `base` (parameters that offsets start
from, or null), `driver features` (of the driver, or null), `renew` (frame at which the policy's memory begins), and for each of
`FOLLOWERS` its `track` and `places` (edge and position on it of leader and follower at frame 0); arrays `I/leader` and
`I/follower` `(3, T)` of pair I: position, speed, acceleration. Pairs of one scene are on the road together.

Answer: for pair I and each F of `FOLLOWERS` the arrays `I/F/motion` `(T, 2)` (speed, gap to the leader ahead) and `I/F/place`
`(T, 2, 3)` (x, y and heading in degrees of leader and follower); `I/parameters` `(T, n)` of the policy, NaN where it does not
drive; or a header with `error`. SI units.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cfx.errors import CfxError
from cfx.simulators.sumo.channel import Array, Message, receive, send

FOLLOWERS = ("real", "policy", "default")
"""Who drives behind a copy of the same leader: the recording, the job's policy, the model's default parameters."""

CAR_LENGTH = 4.5
"""m: followers' lengths stand in no recording of pairs, and change nothing."""

LOOK_AHEAD = 1e4
"""m: whoever falls far behind still follows his leader, as in memory."""

_OPTIONS = (
    *("--collision.action", "none"),
    *("--time-to-teleport", "-1"),
    *("--no-step-log", "true"),
    *("--duration-log.disable", "true"),
    *("--no-warnings", "true"),
)


class Recorded:
    """A vehicle that drives exactly as it was recorded.

    SUMO moves it from where it is to its next position; then its speed and acceleration are put right, as recorded positions are
    rarely the sums of recorded speeds. SUMO drives nobody backwards, so that is a jump.
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
        sumo.vehicle.setSpeed(
            self.name,
            max(0.0, (self.position[frame] - self.now(sumo)) / sumo.simulation.getDeltaT()),
        )

    def settle(self, sumo: Any, frame: int) -> None:
        """Puts speed and acceleration right after a step."""
        back = self.position[frame] - self.now(sumo)
        if back < -1e-9:
            sumo.vehicle.moveTo(
                self.name,
                sumo.vehicle.getLaneID(self.name),
                max(0.0, sumo.vehicle.getLanePosition(self.name) + back),
            )
            self._jumps += back
        sumo.vehicle.setPreviousSpeed(self.name, self.speed[frame], self.acceleration[frame])


class Behind:
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
        """After a step: puts what is replayed right, and notes where everybody is."""
        self.leader.settle(sumo, frame)
        if self.replayed(frame):
            self.follower.settle(sumo, frame)
        speed = sumo.vehicle.getSpeed(self.follower.name)
        self.motion[frame] = (
            speed,
            self.leader.now(sumo) - self.pair["length"] - self.follower.now(sumo),
        )
        for k, vehicle in enumerate((self.leader.name, self.follower.name)):
            self.place[frame, k] = (
                *sumo.vehicle.getPosition(vehicle),
                sumo.vehicle.getAngle(vehicle),
            )

    def aim(self, sumo: Any, frame: int) -> None:
        """Before a step: says where those who are replayed shall be at `frame`."""
        self.leader.aim(sumo, frame)
        if self.replayed(frame):
            self.follower.aim(sumo, frame)


def drive(request: Message) -> dict[str, Array]:
    """Drives all scenes, one after another.

    Raises:
        CfxError: the policy cannot drive, or SUMO lost a vehicle.
    """
    import libsumo

    found: dict[str, Array] = {}
    header, arrays = request
    for scene in sorted({pair["scene"] for pair in header["pairs"]}):
        members = [(i, pair) for i, pair in enumerate(header["pairs"]) if pair["scene"] == scene]
        found |= _scene(libsumo, header, members, arrays)
    return found


def _scene(
    sumo: Any,
    header: Mapping[str, Any],
    pairs: Sequence[tuple[int, Any]],
    arrays: Mapping[str, Array],
) -> dict[str, Array]:
    from cfx.sumo.driver import Driver

    policy = Driver.load(header["policy"], network=None, look_ahead=LOOK_AHEAD)
    drivers = {
        "policy": policy,
        "default": Driver.constant(policy.model, dt=header["dt"], look_ahead=LOOK_AHEAD),
    }
    roads = [Behind(i, kind, pair, arrays) for i, pair in pairs for kind in FOLLOWERS]
    chosen = {
        i: np.full((len(arrays[f"{i}/leader"][0]), len(policy.policy.space)), np.nan)
        for i, _ in pairs
    }
    for i, pair in pairs:
        policy.assign(
            f"{i}/policy",
            pair["network"],
            base=pair["base"],
            driver_features=pair["driver_features"],
        )
    with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as folder:
        routes = Path(folder, "scene.rou.xml")
        routes.write_text(_routes(header, roads), encoding="utf-8")
        sumo.start(
            [
                "sumo",
                "-n",
                header["net"],
                "-r",
                str(routes),
                "--step-length",
                repr(header["dt"]),
                *_OPTIONS,
            ]
        )
        try:
            for frame in range(max(road.frames for road in roads)):
                sumo.simulationStep()
                _frame(
                    sumo, [road for road in roads if frame < road.frames], frame, drivers, chosen
                )
        finally:
            sumo.close()
    found: dict[str, Array] = {f"{road.number}/{road.kind}/motion": road.motion for road in roads}
    found |= {f"{road.number}/{road.kind}/place": road.place for road in roads}
    return found | {f"{i}/parameters": parameters for i, parameters in chosen.items()}


def _frame(
    sumo: Any,
    roads: Sequence[Behind],
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
        own = [road for road in roads if road.kind == kind]
        for road in own:
            if frame == road.pair["renew"] > 0:
                driver.renew(road.follower.name)
        driver.step(
            sumo, [road.follower.name for road in own if frame < road.pair["first"]], drive=False
        )
        driver.step(sumo, [road.follower.name for road in own if frame >= road.pair["first"]])
    for road in roads:
        if road.kind == "policy" and frame >= road.pair["first"]:
            chosen[road.number][frame] = (
                list(drivers["policy"].parameters(road.follower.name).values()) or np.nan
            )
        if frame + 1 < road.frames:
            road.aim(sumo, frame + 1)
        else:
            for vehicle in (road.leader.name, road.follower.name):
                sumo.vehicle.remove(vehicle)


def _routes(header: Mapping[str, Any], roads: Sequence[Behind]) -> str:
    """Returns SUMO's route file: all vehicles at frame 0, under no limit but what drives them."""
    free = 'minGap="0" maxSpeed="130" speedFactor="100" speedDev="0" sigma="0"'
    edges = header["edges"]
    lines = [f'<route id="from{k}" edges="{" ".join(edges[k:])}"/>' for k in range(len(edges))]
    for road in roads:
        lanes = header["tracks"][road.pair["track"][road.kind]]
        for vehicle, length, (edge, at) in zip(
            (road.leader, road.follower),
            (road.pair["length"], CAR_LENGTH),
            road.pair["places"][road.kind],
            strict=True,
        ):
            lines.append(f'<vType id="type/{vehicle.name}" length="{length!r}" {free}/>')
            lines.append(
                f'<vehicle id="{vehicle.name}" type="type/{vehicle.name}" route="from{edge}" depart="0" insertionChecks="none"'
                f' departLane="{lanes[edge]}" departPos="{at!r}" departSpeed="{max(0.0, vehicle.speed[0])!r}"/>'
            )
    return "\n".join(["<routes>", *lines, "</routes>"])


def main() -> None:
    """Answers one request."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO prints; the answer must stay clean
    request = receive(sys.stdin.buffer)
    if request is None:
        return
    try:
        found = drive(request)
    except Exception as error:  # whatever it is, the job tells it
        lost = type(error).__module__.partition(".")[0] in {"libsumo", "traci"}
        kind = type(error).__name__ if not isinstance(error, CfxError) and not lost else ""
        send(
            answers,
            {
                "error": f"SUMO lost a vehicle or refuses one ({error})" if lost else str(error),
                "bug": kind,
            },
        )
    else:
        send(answers, {}, found)


if __name__ == "__main__":
    # pandas loads pyarrow where it finds it.
    sys.modules["pyarrow"] = None  # type: ignore[assignment]  # Python's own way to say that a module is not there
    main()
