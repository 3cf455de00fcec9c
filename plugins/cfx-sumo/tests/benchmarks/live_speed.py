"""How much of real time live drivers take in SUMO, beside SUMO alone in the same run.

    python -m plugins.cfx-sumo.tests.benchmarks.live_speed cfx://idm --vehicles 10 100 1000 5000

Lanes of 50 vehicles behind heads at 14 m/s, steps of 0.1 s, libsumo in one process for each row. A
row has processor time: how many times real time SUMO alone takes, how many with drivers, and what a
driver costs for a vehicle and step beyond SUMO's own time, in microseconds. The least of three runs
counts, as other work on the machine only adds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from cfx_sumo.simulation.network import network

ROW, APART_M, HEAD_M = 50, 30.0, 5000.0

SCRIPT = """
import json, sys, time
sys.modules["pyarrow"] = None
from cfx_sumo.live.driver import Driver
import libsumo
policy, first, steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])

def run(driver):
    libsumo.start(["sumo", "-n", "road.net.xml", "-r", "demand.rou.xml", "--step-length", "0.1",
                   "--no-step-log", "--no-warnings"])
    names = []
    for step in range(first + steps):
        if step == first:
            began = time.process_time()
        libsumo.simulationStep()
        if driver is not None:
            if not names:
                names = [name for name in libsumo.vehicle.getIDList() if name[0] == "c"]
            driver.step(libsumo, names)
    took = time.process_time() - began
    count = libsumo.vehicle.getIDCount()
    libsumo.close()
    return took, count

alone, driven = [], []
for _ in range(3):
    alone.append(run(None)[0])
    took, count = run(Driver.load(policy))
    driven.append(took)
print(json.dumps([count, min(alone) / steps, min(driven) / steps]))
"""


def _write(folder: Path, vehicles: int) -> None:
    """Writes the road and the vehicles: a head before each lane's cars."""
    lanes = -(-vehicles // ROW)
    (folder / "road.net.xml").write_text(network(lanes, length=20000.0), encoding="utf-8")
    kinds = '<vType id="car" speedDev="0"/><vType id="head" maxSpeed="14" speedDev="0"/>'
    lines = [kinds]
    for lane in range(lanes):
        lines.append(f'<route id="r{lane}" edges="road{lane}"/>')
        for row in range(min(ROW, vehicles - lane * ROW) + 1):
            kind, name = ("head", "h") if row == 0 else ("car", "c")
            lines.append(
                f'<vehicle id="{name}{lane}/{row}" type="{kind}" route="r{lane}" depart="0"'
                f' departPos="{HEAD_M - APART_M * row}" departSpeed="10" insertionChecks="none"/>'
            )
    text = f"<routes>{''.join(lines)}</routes>"
    (folder / "demand.rou.xml").write_text(text, encoding="utf-8")


def measure(policy: str, vehicles: int, steps: int) -> tuple[int, float, float]:
    """Returns vehicles, and processor time of a step of SUMO alone and with drivers, s."""
    with tempfile.TemporaryDirectory(prefix="cfx-") as name:
        folder = Path(name)
        _write(folder, vehicles)
        command = [sys.executable, "-c", SCRIPT, policy, "20", str(steps)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    count, alone, driven = json.loads(done.stdout.splitlines()[-1])
    return count, alone, driven


def main() -> None:
    """Prints a row for each number of vehicles."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy")
    parser.add_argument("--vehicles", type=int, nargs="+", default=[10, 100, 1000, 5000])
    arguments = parser.parse_args()
    print("vehicles, SUMO alone (x), drivers (x), microseconds a vehicle and step")
    for vehicles in arguments.vehicles:
        steps = max(60, min(1000, 100_000 // vehicles))
        _, alone, driven = measure(arguments.policy, vehicles, steps)
        cost = (driven - alone) / vehicles * 1e6
        print(f"{vehicles}, {0.1 / alone:.0f}, {0.1 / driven:.2f}, {cost:.2f}", flush=True)


if __name__ == "__main__":
    main()
