"""In town: lights, stops and collisions, with the default speed mode and a ready-made driver."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.forks import Forks

pytest.importorskip("traci", reason="needs the extra sumo")

ASSETS = Path(__file__).parent / "assets"

END_S = 110

CONFIGURATION = f"""<configuration>
<input><net-file value="{ASSETS / "corridor.net.xml"}"/>
  <route-files value="{ASSETS / "corridor.rou.xml"}"/></input>
<time><end value="{END_S}"/><step-length value="0.1"/></time>
<output><fcd-output value="fcd.xml"/><collision-output value="collisions.xml"/></output>
<processing><collision.check-junctions value="true"/></processing>
</configuration>"""
"""Collisions are as SUMO has them unless told otherwise: gaps below minGap are some."""

OWN_PROGRAM = """
import sys
sys.modules["pyarrow"] = None
import libsumo
from cfx_sumo.live.driver import Driver
libsumo.start(["sumo", "-c", "town.sumocfg", "--no-step-log", "--no-warnings"])
driver = Driver.load("cfx://idm")
while libsumo.simulation.getTime() < END:
    libsumo.simulationStep()
    names = libsumo.vehicle.getIDList()
    driver.step(libsumo, [one for one in names if libsumo.vehicle.getTypeID(one).startswith("car")])
libsumo.close()
"""


def python(live: Forks, folder: Path, *arguments: str) -> str:
    done = live.run(arguments, folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def positions(folder: Path) -> Iterator[tuple[float, dict[str, tuple[str, float, float]]]]:
    """Yields each instant, with the lane, the place on it and the speed of each vehicle."""
    for instant in ElementTree.parse(folder / "fcd.xml").getroot():  # noqa: S314 - SUMO wrote it
        found = {}
        for one in instant:
            found[one.attrib["id"]] = (
                one.attrib["lane"],
                float(one.attrib["pos"]),
                float(one.attrib["speed"]),
            )
        yield float(instant.attrib["time"]), found


def red_lights_run(folder: Path) -> list[tuple[float, str]]:
    """Returns who entered a junction more than a second after the light had become red.

    All lights: 41 s green for roads `n`, 4 s yellow, 41 s green for roads `a`, 4 s yellow.
    """
    found = []
    before: dict[str, tuple[str, float, float]] = {}
    for time, vehicles in positions(folder):
        for name, (lane, _, _) in vehicles.items():
            came = before.get(name, (":",))[0]
            if lane.startswith(":") and not came.startswith(":"):
                red_since = time % 90.0
                if came.startswith("n"):
                    red_since -= 45.0
                if 1.0 < red_since < 45.0:
                    found.append((time, name))
        before = vehicles
    return found


@pytest.mark.parametrize(
    "way", [pytest.param("a program of one's own", marks=pytest.mark.slow), "cfx drive"]
)
def test_by_default_nobody_runs_a_red_light_passes_a_stop_or_collides(
    way: str, tmp_path: Path, live: Forks
) -> None:
    """`cfx drive` drives by `Fleet.load`."""
    (tmp_path / "town.sumocfg").write_text(CONFIGURATION)
    if way == "cfx drive":
        command = ["-m", "cfx", "drive", "town.sumocfg", "--drivers", "car=cfx://idm"]
        said = python(live, tmp_path, *command)
        row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
        assert row[5:9] == ["0"] * 4, "contact, below minGap, crossing paths, teleports"
    else:
        python(live, tmp_path, "-c", OWN_PROGRAM.replace("END", str(END_S)))
    assert red_lights_run(tmp_path) == []
    assert "<collision " not in (tmp_path / "collisions.xml").read_text()
    at_stop = [
        seen["stops"][2]
        for _, seen in positions(tmp_path)
        if "stops" in seen and 295 < seen["stops"][1] <= 300
    ]
    assert min(at_stop) == 0.0
    crossed = {
        name
        for _, seen in positions(tmp_path)
        for name, (lane, _, _) in seen.items()
        if lane.startswith(":")
    }
    assert len(crossed) > 20, "there was traffic at the lights"


CLOSE = """
import sys
sys.modules["pyarrow"] = None
import json
from pathlib import Path
from cfx_sumo.drive.run import _Run
from cfx_sumo.drive.sumo_process import started
from cfx_sumo.live.driver import Driver
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.demo.motorway import SHIPPED
Path("close.rou.xml").write_text('''<routes><vType id="car" sigma="0" speedDev="0"/>
  <vType id="wall" sigma="0" speedDev="0"/>
  <route id="m" edges="1001 1002 1003"/>
  <vehicle id="touched" type="wall" route="m" depart="0" departPos="200" departSpeed="0"
    departLane="2"><stop lane="1001_2" endPos="201" duration="100"/></vehicle>
  <vehicle id="contact" type="car" route="m" depart="0" departPos="153" departSpeed="20"
    departLane="2" insertionChecks="none"/>
  <vehicle id="neared" type="wall" route="m" depart="0" departPos="200" departSpeed="0"
    departLane="4"><stop lane="1001_4" endPos="201" duration="100"/></vehicle>
  <vehicle id="near" type="car" route="m" depart="0" departPos="150" departSpeed="20"
    departLane="4" insertionChecks="none"/></routes>''')
command = ["sumo", "-n", str(SHIPPED), "-r", "close.rou.xml", "--step-length", "0.1",
           "--no-step-log", "--no-warnings", "--collision.action", ACTION]
with started(Path("close"), command, False) as sumo:
    fleet = Fleet({"car": Driver.load("cfx://idm")})
    step = fleet.step
    def careless(connection):
        step(connection)
        for name, at, fastest in (("contact", 300.0, 40.0), ("near", 194.5, 20.0)):
            if name in connection.vehicle.getIDList():
                connection.vehicle.setSpeedMode(name, 0)
                connection.vehicle.setLaneChangeMode(name, 0)
                left = at - connection.vehicle.getLanePosition(name)
                connection.vehicle.setSpeed(name, min(fastest, max(0.0, left / 0.1)))
    fleet.step = careless
    run = _Run(sumo, fleet, Path("close"), None).go(6.0)
tally = run.tallies["car"]
print(json.dumps([tally.collisions, tally.below_min_gap,
                  [[one.collider, one.victim, one.lane, one.gap, one.time]
                   for one in run.collisions]]))
"""


@pytest.mark.parametrize("action", ["teleport", "remove", "warn"])
def test_contact_is_told_apart_from_a_gap_below_min_gap(
    action: str, tmp_path: Path, live: Forks
) -> None:
    """SUMO reports both as collisions; whatever it then does with the vehicles."""
    said = python(live, tmp_path, "-c", CLOSE.replace("ACTION", f'"{action}"'))
    contacts, below, collisions = json.loads(said.splitlines()[-1])
    assert (contacts, below) == (1, 1)
    who = {one[0]: one for one in collisions}
    assert set(who) == {"contact", "near"}, "each once, however long it lasts"
    assert who["near"][1:3] == ["neared", "1001_4"]
    assert 0 < who["near"][3] < 2.5
    assert who["contact"][1:3] == ["touched", "1001_2"]
    assert who["contact"][3] <= 0.0
    assert 1.0 < who["contact"][4] < who["near"][4] < 6.0
