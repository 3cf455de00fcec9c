"""Saturation flow at a signal: how many vehicles an hour of green a standing queue lets through.

    python -m tests.benchmarks.saturation_flow cfx://idm cfx://i80-idm --cycles 8

A lane of 60 km/h with a light (41 s green, 4 s yellow, 45 s red) and more vehicles than it lets
through. As in the Highway Capacity Manual the headways of a queue are taken as they cross the stop
line: those of the fifth vehicle and later give the saturation flow, and what the first four take
longer is the start-up lost time. `sumo:ATTRIBUTES` is a vType that SUMO drives by itself.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile

SCRIPT = """
import json, sys
sys.modules["pyarrow"] = None
import numpy as np
import libsumo
from cfx_sumo.drive.scenarios import ASSETS, CAR
from cfx_sumo.live.driver import Driver
policy, cycles, step = sys.argv[1], int(sys.argv[2]), sys.argv[3]
kind = CAR
if policy.startswith("sumo:"):
    kind = CAR.replace("/>", " " + policy[5:] + "/>")
    for part in policy[5:].split():
        name = part.split("=")[0]
        kind = kind.replace(CAR[CAR.find(name + "="):].split()[0] + " ", "", 1) if f" {name}=" in CAR else kind
with open("queue.rou.xml", "w") as file:
    file.write(f'<routes>{kind}<route id="r" edges="before after"/><flow id="car" type="car"'
               ' route="r" begin="0" end="100000" vehsPerHour="1800" departSpeed="desired"/></routes>')
libsumo.start(["sumo", "-n", str(ASSETS / "town.net.xml"), "-r", "queue.rou.xml", "--step-length",
               step, "--no-step-log", "--no-warnings", "--time-to-teleport", "-1"])
driver = None if policy.startswith("sumo:") else Driver.load(policy)
crossed, queue, before, gaps = [], set(), set(), []
collisions = 0
last = 1000
headways = []
green = None
for number in range(round(90 * (cycles + 2) / float(step))):
    libsumo.simulationStep()
    now = libsumo.simulation.getTime()
    if driver is not None:
        driver.step(libsumo, libsumo.vehicle.getIDList())
    collisions += libsumo.simulation.getCollidingVehiclesNumber()
    on = libsumo.lane.getLastStepVehicleIDs("before_0")
    phase = libsumo.trafficlight.getPhase("light")
    if phase != last:
        if phase == 2 and now > 180:
            green, crossed = now, []
            queue = [v for v in on if libsumo.vehicle.getSpeed(v) < 1.0]
            queue.sort(key=libsumo.vehicle.getLanePosition, reverse=True)
            places = [libsumo.vehicle.getLanePosition(v) for v in queue]
            still = [libsumo.vehicle.getSpeed(v) < 0.1 for v in queue]
            gaps += [a - b - 4.5 for a, b, s in zip(places, places[1:], still[1:]) if s]
        if phase == 0 and green is not None:
            headways.append(np.diff([green, *crossed]).tolist())
            green = None
        last = phase
    if green is not None:
        crossed += [now for v in sorted(before - set(on)) if v in queue]
    before = set(on)
libsumo.close()
late = [h for one in headways for h in one[4:]]
hs = float(np.mean(late))
lost = float(np.mean([sum(one[:4]) - 4 * hs for one in headways]))
first = float(np.mean([one[0] for one in headways]))
share = None if driver is None else driver.counts.outside / max(1, driver.counts.steps)
print(json.dumps([3600 / hs, lost, first, float(np.mean(gaps)), len(late), collisions, share]))
"""


def main() -> None:
    """Prints a row for each policy."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--cycles", type=int, default=8)
    parser.add_argument("--step", default="0.1")
    arguments = parser.parse_args()
    print(
        "policy | saturation flow (vehicles an hour) | start-up lost time (s) | first vehicle (s)"
        " | gap at standstill (m) | headways | collisions | outside"
    )
    for policy in arguments.policies:
        with tempfile.TemporaryDirectory(prefix="cfx-") as folder:
            command = [sys.executable, "-c", SCRIPT, policy, str(arguments.cycles), arguments.step]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            print(policy, done.stderr.splitlines()[-1])
            continue
        flow, lost, first, gap, number, hits, share = json.loads(done.stdout.splitlines()[-1])
        outside = "" if share is None else f"{100 * share:.0f} %"
        print(
            f"{policy} | {flow:.0f} | {lost:.1f} | {first:.1f} | {gap:.1f} | {number} | {hits}"
            f" | {outside}",
            flush=True,
        )


if __name__ == "__main__":
    main()
