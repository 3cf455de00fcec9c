"""SUMO's own IDM: a job as JSON on stdin, speeds and positions as JSON on stdout.

libsumo needs a process of its own. Job: `{"runs": [{"parameters": {attribute: value},
"leader_speed": [...], "gap": m, "speed": m/s}, ...]}`; steps of 0.1 s, every leader 5 m long. Each
run has a road of its own, and all are simulated at once. Answer: `[[leader positions, positions,
speeds], ...]`.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

LIMIT = 130.0  # m/s: the roads have no other
START = 300.0  # m: front of every leader


def network(count: int) -> str:
    length = 6000.0
    bounds = f'convBoundary="0,0,{length},{count}" origBoundary="0,0,1,1"'
    lines = ['<net version="1.20">']
    lines.append(f'<location netOffset="0,0" {bounds} projParameter="!"/>')
    for i in range(count):
        y = 100 * i
        lines.append(f'<edge id="r{i}" from="a{i}" to="b{i}" priority="1">')
        lines.append(f'<lane id="r{i}_0" index="0" speed="{LIMIT}" length="{length}"')
        lines.append(f' shape="0,{y} {length},{y}"/></edge>')
    for i in range(count):
        y = 100 * i
        lines.append(f'<junction id="a{i}" type="dead_end" x="0" y="{y}"')
        lines.append(f' incLanes="" intLanes="" shape="0,{y}"/>')
        lines.append(f'<junction id="b{i}" type="dead_end" x="{length}" y="{y}"')
        lines.append(f' incLanes="r{i}_0" intLanes="" shape="0,{y}"/>')
    return "\n".join([*lines, "</net>"])


def routes(runs: list[dict[str, Any]]) -> str:
    same = 'length="5" sigma="0" speedFactor="1" speedDev="0"'
    types, cars = [f'<vType id="lead" maxSpeed="{LIMIT}" {same}/>'], []
    for i, run in enumerate(runs):
        given = " ".join(f'{name}="{value!r}"' for name, value in run["parameters"].items())
        types.append(
            f'<vType id="t{i}" carFollowModel="IDM" {same} {given}/><route id="r{i}" edges="r{i}"/>'
        )
        for name, kind, position, speed in (
            ("leader", "lead", START, run["leader_speed"][0]),
            ("follower", f"t{i}", START - 5.0 - run["gap"], run["speed"]),
        ):
            cars.append(f'<vehicle id="{name}{i}" type="{kind}" route="r{i}" depart="0"')
            cars.append(' insertionChecks="none"')
            cars.append(f' departPos="{position!r}" departSpeed="{speed!r}"/>')
    return "\n".join(["<routes>", *types, *cars, "</routes>"])


def simulate(sumo: Any, runs: list[dict[str, Any]]) -> list[list[list[float]]]:
    sumo.simulationStep()
    answer: list[list[list[float]]] = [[[], [], []] for _ in runs]
    for frame in range(len(runs[0]["leader_speed"])):
        for i, run in enumerate(runs):
            if frame == 0:
                sumo.vehicle.setSpeedMode(f"leader{i}", 0)  # it takes the speeds that are set
            else:
                sumo.vehicle.setSpeed(f"leader{i}", run["leader_speed"][frame])
        if frame:
            sumo.simulationStep()
        for i in range(len(runs)):
            answer[i][0].append(sumo.vehicle.getLanePosition(f"leader{i}"))
            answer[i][1].append(sumo.vehicle.getLanePosition(f"follower{i}"))
            answer[i][2].append(sumo.vehicle.getSpeed(f"follower{i}"))
    return answer


def main() -> None:
    with contextlib.redirect_stdout(sys.stderr):  # it may print a warning
        import libsumo

    runs = json.load(sys.stdin)["runs"]
    with tempfile.TemporaryDirectory() as folder:
        net, cars = Path(folder, "net.net.xml"), Path(folder, "cars.rou.xml")
        net.write_text(network(len(runs)))
        cars.write_text(routes(runs))
        options = [
            "--step-length",
            "0.1",
            "--collision.action",
            "none",
            "--time-to-teleport",
            "-1",
            "--no-step-log",
            "true",
        ]
        libsumo.start(["sumo", "-n", str(net), "-r", str(cars), "--no-warnings", "true", *options])
        answer = simulate(libsumo, runs)
        libsumo.close()
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
