"""Scenarios that come with cfx, and the stress test, with a ready-made policy."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cfx_sumo.drive.queue import QueueAtLight
from cfx_sumo.drive.tally import Histogram
from tests.forks import Forks

pytest.importorskip("traci", reason="needs the extra sumo")


def drive(live: Forks, folder: Path, *arguments: str) -> str:
    done = live.run(["-m", "cfx", "drive", *arguments], folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_drive_needs_no_arguments(tmp_path: Path) -> None:
    """Nor anybody who keeps pyarrow away from libsumo: the command does."""
    command = [sys.executable, "-m", "cfx", "drive", "--end", "20"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = done.stdout
    assert "200 steps of 0.1 s" in said
    assert "at most 22 of these vehicles at once" in said
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert row[1] == "22"
    assert row[5] == "0"  # collisions
    assert "its recording" in said
    assert not list(tmp_path.iterdir())


def test_the_motorway_has_waves_and_lane_changes(tmp_path: Path, live: Forks) -> None:
    said = drive(live, tmp_path, "motorway", "--drivers", "car=cfx://krauss", "--end", "60")
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert int(row[1]) > 50
    assert int(row[4]) > 10  # lane changes
    assert row[5] == "0"  # collisions


EVERY_FLOW = """
import sys
sys.modules["pyarrow"] = None
import json, re, tempfile
from pathlib import Path
import libsumo
from cfx_sumo.drive.scenarios import SCENARIOS
missing = {}
for name, scenario in SCENARIOS.items():
    with tempfile.TemporaryDirectory() as folder:
        configuration = scenario.write(Path(folder))
        libsumo.start(["sumo", "-c", str(configuration), "--step-length", "1", "--no-step-log"])
        entered = set()
        for _ in range(60):
            libsumo.simulationStep()
            for vehicle in libsumo.simulation.getDepartedIDList():
                entered.add(vehicle.partition(".")[0])
        libsumo.close()
    given = re.findall(r'<(?:vehicle|flow) id="(\\w+)"', scenario.routes)
    assert given
    missing[name] = sorted(set(given) - entered)
print(json.dumps(missing))
"""


def test_every_vehicle_and_flow_of_the_scenarios_enters(tmp_path: Path, live: Forks) -> None:
    """SUMO ignores what is out of order in a route file, with no more than a warning."""
    done = live.run(["-c", EVERY_FLOW], tmp_path)
    assert done.returncode == 0, done.stderr
    missing = json.loads(done.stdout.splitlines()[-1])
    assert missing == {"ring": [], "motorway": [], "town": []}
    assert "Warning" not in done.stderr


def town(live: Forks, folder: Path, policy: str, end: int, step: float) -> None:
    command = ["town", "--drivers", f"car={policy}", "--end", str(end), "--step", str(step)]
    said = drive(live, folder, *command)
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert int(row[1]) > end
    assert row[5:9] == ["0"] * 4  # contact, gaps below minGap, crossing paths, teleports


def test_the_town_has_no_collisions(tmp_path: Path, live: Forks) -> None:
    """At lights, where left turns give way, and at the roundabout; with SUMO's checks."""
    town(live, tmp_path, "cfx://w99", 100, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["cfx://w99", "cfx://idm"])
@pytest.mark.parametrize("step", [0.05, 0.1, 0.5, 1.0])
def test_the_town_has_no_collisions_at_any_step(
    policy: str, step: float, tmp_path: Path, live: Forks
) -> None:
    town(live, tmp_path, policy, 200, step)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.05, 0.1, 0.5, 1.0])
def test_stress_finds_no_collision_and_no_step_outside_the_limits(
    step: float, tmp_path: Path, live: Forks
) -> None:
    """A few events of each kind; the cards hold those of a thousand."""
    script = f"""
import sys
sys.modules["pyarrow"] = None
import json
from cfx_sumo.drive.stress import run_stress
result = run_stress({{"car": "cfx://idm"}}, seed=3, cut_ins=30, step={step})
print(json.dumps(result.to_json()))
"""
    done = live.run(["-c", script], tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    events, town = found["events"], found["town"]
    assert [event["kind"] for event in events] == [
        "cut-ins",
        "leaders braking at 9 m/s2",
        "standing vehicles",
        "a lane drop",
        "a red light",
        "a queue at a light",
        "crossing traffic in town",
    ]
    # Each vehicle that cuts in or brakes is the next ahead of the car, at a gap that was asked for.
    assert events[0]["number"] == 30
    assert events[1]["number"] == 6
    assert 0 < events[0]["headway"][0] < 0.5
    assert 1.0 < events[1]["headway"][0] < events[1]["headway"][2] < 3.0
    assert events[2]["headway"] is None
    assert events[3]["number"] > 100
    assert events[6]["number"] > 200
    assert 1200 < town["saturation_flow"] < 2000
    assert 2.5 < town["standing_gap"] < 4.0
    assert 0 < town["outside"] < 1
    for event in events:
        assert event["collisions"] == 0
        assert 0.5 < event["hardest_braking"] <= 9.0 + 1e-6
        assert event["hardest_acceleration"] <= 2.6 + 1e-6
        assert event["smallest_gap"] > 0


class Light:
    """A light, and seven cars that cross its line 3, 5, 7.5 s and so on after it turns green."""

    CROSSES = (3.0, 5.0, 7.5, 9.5, 11.5, 13.5, 15.5)

    def __init__(self) -> None:
        self.now = 200.0
        self.simulation = self.lane = self.trafficlight = self.vehicle = self

    def getTime(self) -> float:  # noqa: N802 - SUMO's names
        return self.now

    def getPhase(self, _: str) -> int:  # noqa: N802
        return 2 if 210.0 <= self.now < 240.0 else 0

    def getLastStepVehicleIDs(self, _: str) -> list[str]:  # noqa: N802
        waiting = [f"v{k}" for k, s in enumerate(self.CROSSES) if self.now < 210.0 + s]
        return [*waiting, "late"]

    def getSpeed(self, name: str) -> float:  # noqa: N802
        return 10.0 if name == "late" else 0.0

    def getLanePosition(self, name: str) -> float:  # noqa: N802
        return 500.0 - 7.5 * int(name[1:])

    def getLength(self, _: str) -> float:  # noqa: N802
        return 4.5


def test_a_queue_has_its_headways_from_the_fifth_car_on() -> None:
    light, queue = Light(), QueueAtLight()
    for step in range(500):
        queue.act(light, step)
        light.now += 0.1
    assert queue.headways == [pytest.approx([3.0, 2.0, 2.5, 2.0, 2.0, 2.0, 2.0], abs=0.11)]
    assert queue.saturation_flow == pytest.approx(1800, rel=0.02)
    assert queue.lost_time == pytest.approx(1.5, abs=0.3)
    assert queue.gaps == pytest.approx([3.0] * 6)


def test_without_a_window_gui_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from cfx.app.cli import main
    from cfx_sumo.drive import sumo_process

    monkeypatch.setitem(sys.modules, "pyarrow", sys.modules.get("pyarrow"))
    monkeypatch.setitem(sys.modules, "sumo", None)
    monkeypatch.setattr(sumo_process.shutil, "which", lambda _: None)
    assert main(["drive", "ring", "--gui"]) == 2
    assert capsys.readouterr().err.strip() == (
        "--gui needs SUMO's window, sumo-gui: pip install eclipse-sumo"
    )


def test_quantiles_are_those_of_the_values() -> None:
    values = np.random.default_rng(0).normal(1.0, 2.0, 20_000)
    histogram = Histogram(-15.0, 15.0, 0.02)
    for part in np.split(values, 10):
        histogram.add(part)
    for share in (0.05, 0.5, 0.999):
        assert histogram.quantile(share) == pytest.approx(np.quantile(values, share), abs=0.1)
    histogram.add([float("nan"), 1e9, -1e9])
    assert histogram.counts.sum() == 20_002
    assert np.isnan(Histogram(0.0, 1.0, 0.1).quantile(0.5))
