"""Followers in SUMO itself: a job as JSON on stdin, their trajectories as JSON on stdout.

Runs as a process of its own, because libsumo and pyarrow do not get on in one. All followers of a
job drive at once, each on its own road behind its own leader.

Job: `{"dt": s, "runs": [run, ...]}`. Run: `model` (SUMO's name), `parameters` and `leader` (SUMO's
vType attributes of the follower and of the leader), `leader_speed` (frames 0 to T - 1),
`leader_position`, `leader_acceleration` (frame 0), `leader_length`, and `position`, `speed`,
`acceleration` of the follower at frame 0. SI units. Answer: `{"runs": [{"speed": [...], "position":
[...], "leader_position": [...]}, ...]}`, T frames each.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

Job = dict[str, Any]

_FAST = 130.0  # m/s: no lane or vehicle limit below this


def main() -> None:
    with contextlib.redirect_stdout(sys.stderr):  # it may print a warning about pyarrow
        import libsumo

    job: Job = json.load(sys.stdin)
    with tempfile.TemporaryDirectory() as folder:
        net, routes = Path(folder, "net.net.xml"), Path(folder, "routes.rou.xml")
        net.write_text(_network(job["runs"]))
        routes.write_text(_routes(job["runs"]))
        command = [
            "sumo",
            "-n",
            str(net),
            "-r",
            str(routes),
            "--step-length",
            repr(job["dt"]),
            "--collision.action",
            "none",
        ]
        command += [
            "--time-to-teleport",
            "-1",
            "--no-step-log",
            "true",
            "--no-warnings",
            "true",
            "--seed",
            "1",
        ]
        libsumo.start(command)
        answer = _drive(libsumo, job["runs"])
        libsumo.close()
    json.dump({"runs": answer}, sys.stdout)


def _drive(sumo: Any, runs: list[Job]) -> list[Job]:
    sumo.simulationStep()  # inserts all vehicles at frame 0
    answer: list[Job] = []
    for i, run in enumerate(runs):
        leader, follower = f"leader{i}", f"follower{i}"
        sumo.vehicle.setLaneChangeMode(leader, 0)
        sumo.vehicle.setLaneChangeMode(follower, 0)
        sumo.vehicle.setSpeedMode(leader, 0)  # drives what it is told, whatever its limits
        sumo.vehicle.setPreviousSpeed(leader, run["leader_speed"][0], run["leader_acceleration"])
        sumo.vehicle.setPreviousSpeed(follower, run["speed"], run["acceleration"])
        answer.append(
            {
                "speed": [run["speed"]],
                "position": [run["position"]],
                "leader_position": [run["leader_position"]],
            }
        )
    for frame in range(1, max(len(run["leader_speed"]) for run in runs)):
        driving = [i for i, run in enumerate(runs) if frame < len(run["leader_speed"])]
        for i in driving:
            sumo.vehicle.setSpeed(f"leader{i}", runs[i]["leader_speed"][frame])
        sumo.simulationStep()
        for i in driving:
            answer[i]["speed"].append(sumo.vehicle.getSpeed(f"follower{i}"))
            answer[i]["position"].append(sumo.vehicle.getLanePosition(f"follower{i}"))
            answer[i]["leader_position"].append(sumo.vehicle.getLanePosition(f"leader{i}"))
    return answer


def _network(runs: list[Job]) -> str:
    """One straight road for each run, long enough for both vehicles; needs no netconvert."""
    length = 2000.0 + max(
        run["leader_position"] + len(run["leader_speed"]) * max(run["leader_speed"]) for run in runs
    )
    lines = [
        '<net version="1.20">',
        f'<location netOffset="0,0" convBoundary="0,0,{length},{100 * len(runs)}"'
        ' origBoundary="0,0,1,1" projParameter="!"/>',
    ]
    for i in range(len(runs)):
        y = 100 * i
        lines.append(
            f'<edge id="road{i}" from="from{i}" to="to{i}" priority="1">'
            f'<lane id="road{i}_0" index="0" speed="{_FAST}"'
        )
        lines.append(f' length="{length}" shape="0,{y} {length},{y}"/></edge>')
    for i in range(len(runs)):
        y = 100 * i
        lines.append(
            f'<junction id="from{i}" type="dead_end" x="0" y="{y}" incLanes="" intLanes=""'
            f' shape="0,{y}"/>'
        )
        lines.append(
            f'<junction id="to{i}" type="dead_end" x="{length}" y="{y}" incLanes="road{i}_0"'
            f' intLanes="" shape="{length},{y}"/>'
        )
    return "\n".join([*lines, "</net>"])


def _routes(runs: list[Job]) -> str:
    lines = ["<routes>"]
    for i, run in enumerate(runs):
        given = " ".join(f'{name}="{value!r}"' for name, value in run["parameters"].items())
        ahead = " ".join(f'{name}="{value!r}"' for name, value in run["leader"].items())
        lines.append(
            f'<vType id="lead{i}" maxSpeed="{_FAST}" sigma="0" speedFactor="1" speedDev="0" {ahead}'
        )
        lines.append(f' length="{run["leader_length"]!r}"/>')
        lines.append(
            f'<vType id="drive{i}" carFollowModel="{run["model"]}" sigma="0" speedFactor="1"'
            f' speedDev="0" {given}/>'
        )
        lines.append(f'<route id="route{i}" edges="road{i}"/>')
    for i, run in enumerate(runs):
        for name, kind, position, speed in (
            ("leader", "lead", run["leader_position"], run["leader_speed"][0]),
            ("follower", "drive", run["position"], run["speed"]),
        ):
            lines.append(
                f'<vehicle id="{name}{i}" type="{kind}{i}" route="route{i}" depart="0"'
                ' insertionChecks="none"'
            )
            lines.append(f' departPos="{position!r}" departSpeed="{speed!r}"/>')
    return "\n".join([*lines, "</routes>"])


if __name__ == "__main__":
    main()
