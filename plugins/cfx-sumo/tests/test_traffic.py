"""`cfx drive stress --traffic`."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from cfx.errors import ConfigError, NotInstalledError, SumoError
from cfx.plugin import traffic
from cfx.policies.ready.traffic_table import traffic_lines
from cfx_sumo.commands import DriveCommand
from cfx_sumo.drive import traffic as stress_traffic
from cfx_sumo.drive.traffic import (
    REFERENCE,
    TrafficReport,
    check_alone,
    measure_traffic,
    print_traffic,
    write_traffic,
)
from tests.forks import Forks

ALONE = traffic.DriverTraffic(
    equilibrium=np.full((len(traffic.SPEEDS_MPS), 2), 1500.0),
    ring=np.array([[20.0, 1200.0], [40.0, 1900.0]]),
    dips=np.linspace(5.0, 9.0, traffic.PLATOON + 1),
    time_gaps=np.full((3, 3), 1.5),
    measures=(
        traffic.Measure.of("capacity", 1900.0, 0.1),
        traffic.Measure.of("ring_wave_speed", float("nan"), 0.1),
    ),
)


def report() -> TrafficReport:
    return TrafficReport("JOB", traffic.recorded_flows("human"), ALONE, ALONE.measures)


def test_it_is_written_for_people_and_for_cards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_traffic(report(), tmp_path / "new", "cfx drive stress")
    with (tmp_path / "new" / "traffic.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["outside"] for row in rows] == ["low", ""]
    assert (tmp_path / "new" / "traffic.png").stat().st_size > 10_000
    card = json.loads((tmp_path / "new" / "traffic.json").read_text())
    lines = traffic_lines(card)
    row = "| capacity on rings | 0.1 | 1,900 vehicles/h | 2,050 to 2,400 | **low** |"
    assert row in lines
    assert "cfx drive stress" in lines
    assert "| 10 | 1.50, 1.50, 1.50 | 1.20, 1.45, 1.76 |" in lines
    print_traffic(report())
    said = capsys.readouterr().out
    assert "1,900 vehicles/h" in said
    assert "Time gaps of a fleet at 25 m/s" in said


def test_without_sumo_what_needs_it_is_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> str:
        raise NotInstalledError("SUMO is not installed")

    monkeypatch.setattr(stress_traffic, "require_sumo", missing)
    monkeypatch.setattr(traffic, "driver_traffic", lambda *_, **__: ALONE)
    found = measure_traffic("cfx://idm")
    assert found.measures == ALONE.measures
    assert found.missing.startswith("A light, a lane drop and a town were not measured: SUMO is")


def test_mistakes_are_one_sentence() -> None:
    with pytest.raises(SumoError, match="drives vType 'car' alone"):
        check_alone({"truck": "cfx://idm"})
    command = DriveCommand()
    options = command.parse(["ring", "--traffic", "folder"])
    with pytest.raises(ConfigError, match="belongs to the scenario stress"):
        command.run(options)


WITH_SUMO = """
import json
from cfx_sumo.drive import traffic
found = traffic._with_sumo("cfx://krauss", 1.0, 0, (), lambda: None)
print(json.dumps({one.name: one.value for one in found}))
"""


@pytest.mark.slow
def test_a_light_a_lane_drop_and_a_town_are_measured(tmp_path: Path, live: Forks) -> None:
    assert 'sigma="0.5" tau="1.4"' in REFERENCE
    done = live.run(["-c", WITH_SUMO], tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert 1200 < found["saturation_flow"] < 2400
    assert 800 < found["discharge"] < 2600
    assert 0.5 < found["town_throughput"] < 1.5
