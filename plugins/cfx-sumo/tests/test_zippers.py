"""Two lanes become one by turns: drivers let whoever is ahead on the other lane go first."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.forks import Forks

pytest.importorskip("traci", reason="needs the extra sumo")

START = """
import sys
sys.modules["pyarrow"] = None
import json
from pathlib import Path
import libsumo
from cfx_sumo.drive.scenarios import ASSETS, CAR
from cfx_sumo.live.driver import Driver
from cfx_sumo.live.surroundings import look
from cfx_sumo.live.zippers import Zippers

def start(net, edges, placed):
    lines = ["<routes>", CAR, f'<route id="r" edges="{edges}"/>']
    for name, (lane, position, speed) in sorted(placed.items()):
        lines.append(
            f'<vehicle id="{name}" type="car" route="r" depart="0" departLane="{lane}"'
            f' departPos="{position}" departSpeed="{speed}" insertionChecks="none"/>'
        )
    Path("routes.xml").write_text("\\n".join([*lines, "</routes>"]))
    libsumo.start(["sumo", "-n", str(net), "-r", "routes.xml", "--step-length", "0.5",
                   "--no-step-log", "--no-warnings", "--time-to-teleport", "-1"])
"""


def printed(live: Forks, folder: Path, program: str) -> object:
    done = live.run(["-c", START + program], folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


NEXT_AHEAD = """
placed = {
    "first": (0, 1480.0, 0.0), "second": (1, 1477.0, 0.0), "third": (1, 1465.0, 0.0),
    "fourth": (0, 1450.0, 0.0), "fast": (1, 1446.0, 15.0), "far": (1, 1380.0, 0.0),
}
start(ASSETS / "town.net.xml", "wide narrow", placed)
libsumo.simulationStep()
names = list(placed)
view = look(libsumo, names, 200.0)
zippers = Zippers(libsumo)
turns = zippers.turns(libsumo, view.names, view.seen)
waiting = [view.names[place] for place in turns.places.tolist()]
gaps = dict(zip(waiting, turns.seen.gap.tolist()))
at = {name: libsumo.vehicle.getLanePosition(name) for name in names}
libsumo.close()
start(ASSETS / "streets.net.xml", "left0A0 A0B0", {})
print(json.dumps([sorted(zippers.lanes), gaps, at, Zippers(libsumo).lanes]))
"""


def test_who_is_next_ahead_on_the_other_lane_goes_first(live: Forks, tmp_path: Path) -> None:
    lanes, gaps, at, elsewhere = printed(live, tmp_path, NEXT_AHEAD)
    assert lanes == ["wide_0", "wide_1"]
    assert elsewhere == []
    apart = {
        "second": 0.2,  # side by side
        "third": at["first"] - 4.5 - at["third"],
        "fourth": at["third"] - 4.5 - at["fourth"],
    }
    assert gaps == pytest.approx(apart)


QUEUES = """
def times_at_the_line(**options):
    placed = {
        f"v{place}.{lane}": (lane, 1490.0 - 7.0 * place - 3.0 * lane, 0.0)
        for place in range(8) for lane in (0, 1)
    }
    start(ASSETS / "town.net.xml", "wide narrow", placed)
    driver = Driver.load("cfx://idm", **options)
    crossed, contacts, moved, stood = {}, set(), set(), set()
    for _ in range(90):
        libsumo.simulationStep()
        names = libsumo.vehicle.getIDList()
        driver.step(libsumo, names)
        contacts |= set(libsumo.simulation.getCollidingVehiclesIDList())
        for name in names:
            if libsumo.vehicle.getRoadID(name) == "narrow":
                crossed.setdefault(name, libsumo.simulation.getTime())
            elif libsumo.vehicle.getSpeed(name) > 2.0:
                moved.add(name)
            elif libsumo.vehicle.getSpeed(name) < 0.1 and name in moved:
                stood.add(name)
    libsumo.close()
    return [sorted(crossed.values()), sorted(contacts), len(stood)]

print(json.dumps([times_at_the_line(), times_at_the_line(speed_mode=23)]))
"""


def test_two_queues_become_one_without_stops_at_the_line(live: Forks, tmp_path: Path) -> None:
    (crossed, contacts, stood), (unaware, _, stood_unaware) = printed(live, tmp_path, QUEUES)
    assert len(crossed) == len(unaware) == 16
    assert contacts == []
    assert (crossed[-1] - crossed[0]) / 15 < 2.0
    assert (unaware[-1] - unaware[0]) / 15 > 2.4
    assert stood <= 2
    assert stood_unaware >= 10
