"""Discharge behind a lane drop of SUMO's own models, beside which docs/tried.md puts policies.

    python -m plugins.cfx-sumo.tests.benchmarks.discharge 0.5 'carFollowModel="IDM" tau="1.4"'
    python -m plugins.cfx-sumo.tests.benchmarks.discharge 0.5 --driver cfx://idm 'tau="1.4"' ''

A step of SUMO, s, then attributes of vTypes. The scenario is that of `cfx drive stress --traffic`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

SCRIPT = """
import sys
from xml.etree import ElementTree
sys.modules["pyarrow"] = None
from cfx_sumo.drive import traffic
from cfx_sumo.live.fleet import Fleet
step, given, run = float(sys.argv[1]), sys.argv[2], sys.argv[3]
vtype = ElementTree.fromstring(traffic.CAR)
vtype.attrib.update(ElementTree.fromstring(f"<vType {given}/>").attrib)
kind = ElementTree.tostring(vtype, encoding="unicode")
scenario = traffic._DROP._replace(routes=traffic._DROP.routes.replace(traffic.CAR, kind))
fleet = Fleet.load({"car": run}, seed=0) if run else None
passed = traffic._Arrivals(traffic._DROP_FROM_S)
traffic._simulate(scenario, fleet, traffic._DROP_S, step, 0, (), passed)
print(f"{passed.count * 3600.0 / (traffic._DROP_S - traffic._DROP_FROM_S):.0f}")
"""


def main() -> None:
    """Prints a row for each vType."""
    parser = argparse.ArgumentParser()
    parser.add_argument("step")
    parser.add_argument("--driver", default="")
    parser.add_argument("vtypes", nargs="+")
    options = parser.parse_args()
    print("vType | discharge (vehicles/h)")
    for given in options.vtypes:
        command = [sys.executable, "-c", SCRIPT, options.step, given, options.driver]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(f"{given} | {done.stdout.strip()}", flush=True)


if __name__ == "__main__":
    main()
