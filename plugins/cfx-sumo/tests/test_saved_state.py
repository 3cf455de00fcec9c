"""Drivers save their state beside SUMO's: what goes on from there is what would have been."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cfx.errors import DataError, OutputError
from cfx_sumo.live.driver import Driver
from cfx_sumo.live.fleet import Fleet
from tests.agents import adaptive
from tests.forks import Forks
from tests.road import Road, platoon

pytest.importorskip("traci", reason="needs the extra sumo")

SAVE_AND_GO_ON = """
import sys
sys.modules["pyarrow"] = None
import json, re
from pathlib import Path
import libsumo
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.live.fleet import Fleet

scenario = SCENARIOS["ring"].write(Path("."))
routes = Path("scenario.rou.xml")
text = routes.read_text()
text = text.replace("<route id=", '<vType id="other" length="4.5" maxSpeed="40" speedDev="0"/><route id=', 1)
for number in range(0, 22, 3):
    text = text.replace(f'id="car{number}" type="car"', f'id="car{number}" type="other"')
routes.write_text(text)
command = ["sumo", "-c", str(scenario), "--no-step-log", "--no-warnings",
           "--save-state.precision", "17"]
runs = {"car": "cfx://idm-stochastic", "other": "cfx://w99"}

def speeds(fleet, until):
    found = []
    while libsumo.simulation.getTime() < until - 1e-9:
        libsumo.simulationStep()
        fleet.step(libsumo)
        for name in sorted(libsumo.vehicle.getIDList()):
            found.append(libsumo.vehicle.getSpeed(name))
            found.append(libsumo.vehicle.getLanePosition(name))
    return found

libsumo.start(command)
fleet = Fleet.load(runs, seed=5)
speeds(fleet, 12.3)  # within a window
libsumo.simulation.saveState("sumo.xml")
fleet.save_state("drivers.state")
expected = speeds(fleet, 25.0)
libsumo.simulation.loadState("sumo.xml")
fleet.load_state(libsumo, "drivers.state")
same = speeds(fleet, 25.0)
libsumo.close()
libsumo.start([*command, "--load-state", "sumo.xml"])
new = Fleet.load(runs, seed=5)
new.load_state(libsumo, "drivers.state")
another = speeds(new, 25.0)
libsumo.close()
print(json.dumps([expected, same, another]))
"""


def test_a_simulation_that_goes_on_from_a_saved_state_is_the_same(
    tmp_path: Path, live: Forks
) -> None:
    done = live.run(["-c", SAVE_AND_GO_ON], tmp_path)
    assert done.returncode == 0, done.stderr
    expected, same, another = json.loads(done.stdout.splitlines()[-1])
    assert len(expected) > 22 * 127
    assert same == expected
    assert another == expected


RAISED = """
import sys
sys.modules["pyarrow"] = None
import json
import libsumo
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.live.control import VehicleControl
from pathlib import Path

scenario = SCENARIOS["ring"].write(Path("."))
command = ["sumo", "-c", str(scenario), "--no-step-log", "--no-warnings",
           "--save-state.precision", "17"]

def at(vehicle="car7"):
    return [libsumo.vehicle.getTypeID(vehicle), libsumo.vehicle.getDecel(vehicle)]

def brakes(control, *decelerations):
    said = []
    for deceleration in decelerations:
        needed = {"car7": deceleration} if deceleration else {}
        control.bound_braking(libsumo, ["car7"], needed)
        libsumo.simulationStep()
        said.append(at())
    return said

libsumo.start(command)
libsumo.simulationStep()
control = VehicleControl(31)
control.take(libsumo, "car7")
brakes(control, 7.0588235)
libsumo.simulation.saveState("sumo.xml")
state = json.loads(json.dumps(control.described()))
said = [brakes(control, 7.0588235, 0, 6.1, 0)]
libsumo.simulation.loadState("sumo.xml")
control.go_on(libsumo, state)
said.append(brakes(control, 7.0588235, 0, 6.1, 0))
libsumo.simulation.saveState("again.xml")
state = json.loads(json.dumps(control.described()))
libsumo.close()
libsumo.start([*command, "--load-state", "again.xml"])
new = VehicleControl(31)
new.go_on(libsumo, state)
said.append(brakes(new, 7.0588235, 0, 6.1, 0))
libsumo.close()
print(json.dumps(said))
"""


def test_a_raised_decel_goes_on_to_the_last_bit_and_can_be_raised_again(
    tmp_path: Path, live: Forks
) -> None:
    """SUMO's state has the vType `car@7`, with two decimals, and makes no second one."""
    done = live.run(["-c", RAISED], tmp_path)
    assert done.returncode == 0, done.stderr
    expected, same, another = json.loads(done.stdout.splitlines()[-1])
    assert expected == [["car@car7", 7.0588235], ["car", 4.5], ["car@car7", 6.1], ["car", 4.5]]
    assert same == expected
    assert another == expected


def test_a_state_goes_on_where_it_was_saved_alone(tmp_path: Path) -> None:
    road = platoon(2)
    driver = Driver(adaptive({"name": "krauss"}))
    for _ in range(3):
        road.advance()
        driver.step(road, ["v0", "v1"])
    saved = tmp_path / "state"
    driver.save_state(saved)
    with pytest.raises(OutputError, match="cannot be written"):
        driver.save_state(tmp_path / "nowhere" / "state")
    new = Driver(adaptive({"name": "krauss"}))
    early = platoon(2)
    with pytest.raises(Exception, match=r"was saved at 0.3 s, the simulation is at 0 s; load SUMO"):
        new.load_state(early, saved)
    empty = Road()
    empty.time = road.time
    with pytest.raises(Exception, match="has vehicle 'v0', which the simulation lacks"):
        new.load_state(empty, saved)
    with pytest.raises(DataError, match="of a driver with another policy than this policy"):
        Driver(adaptive({"name": "w99"})).load_state(road, saved)
    both = {"a": Driver(adaptive({"name": "krauss"})), "b": Driver(adaptive({"name": "w99"}))}
    with pytest.raises(DataError, match="holds the state of 1 drivers, this fleet has 2"):
        Fleet(both).load_state(road, saved)
    Fleet(both).save_state(tmp_path / "fleet")
    with pytest.raises(DataError, match="holds the state of a fleet"):
        new.load_state(road, tmp_path / "fleet")
    (tmp_path / "other").write_text("no state")
    with pytest.raises(DataError, match="other holds no state of live drivers"):
        new.load_state(road, tmp_path / "other")
    with pytest.raises(DataError, match="missing is not there"):
        new.load_state(road, tmp_path / "missing")
    assert new.vehicles == ()
    new.load_state(road, saved)
    assert new.vehicles == ("v0", "v1")
    assert road.cars["v0"].told[-1] == road.cars["v0"].told[-2], "SUMO is told again"
    assert new.parameters("v0") == driver.parameters("v0")
