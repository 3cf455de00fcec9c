"""Saturation flow at a signal of SUMO's own models, beside which docs/policies.md puts policies.

    python -m plugins.cfx-sumo.tests.benchmarks.saturation_flow 'carFollowModel="IDM" tau="1"'

Each argument are attributes of a vType. Policies are measured by `cfx drive stress`, in the same
queue.
"""

from __future__ import annotations

import re
import subprocess
import sys

SCRIPT = """
import sys, tempfile
sys.modules["pyarrow"] = None
from pathlib import Path
from cfx_sumo.drive.queue import SECONDS, QueueAtLight, queue_of
from cfx_sumo.drive.sumo_process import command_line, started
queue = QueueAtLight()
with tempfile.TemporaryDirectory() as folder:
    scenario = queue_of(sys.argv[1]).write(Path(folder))
    with started(scenario, command_line(scenario, (), step=None), gui=False) as sumo:
        for step in range(round(SECONDS / sumo.simulation.getDeltaT())):
            sumo.simulationStep()
            queue.act(sumo, step)
gap = sum(queue.gaps) / len(queue.gaps)
print(f"{queue.saturation_flow:.0f} | {queue.lost_time:.1f} | {gap:.1f}")
"""


def with_attributes(kind: str, given: str) -> str:
    """Returns a vType with attributes in place of its own."""
    for name in re.findall(r"(\w+)=", given):
        kind = re.sub(rf'\s{name}="[^"]*"', "", kind)
    return kind.replace("/>", f" {given}/>")


def main() -> None:
    """Prints a row for each vType."""
    from cfx_sumo.drive.scenarios import CAR

    print("vType | saturation flow (vehicles/h) | start-up lost time (s) | gap at standstill (m)")
    for given in sys.argv[1:]:
        command = [sys.executable, "-c", SCRIPT, with_attributes(CAR, given)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(f"{given} | {done.stdout.strip()}", flush=True)


if __name__ == "__main__":
    main()
