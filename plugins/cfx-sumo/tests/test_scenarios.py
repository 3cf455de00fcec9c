"""Scenarios that come with cfx, and the stress test, with a ready-made policy."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cfx_sumo.drive.run import Histogram

pytest.importorskip("traci", reason="needs the extra sumo")


def drive(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "cfx", "drive", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_drive_needs_no_arguments(tmp_path: Path) -> None:
    said = drive(tmp_path, "--end", "20")
    assert "200 steps of 0.1 s" in said
    assert "at most 22 of these vehicles at once" in said
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert row[1] == "22"
    assert row[5] == "0"  # collisions
    assert "its recording" in said
    assert not list(tmp_path.iterdir())


def test_the_motorway_has_waves_and_lane_changes(tmp_path: Path) -> None:
    said = drive(tmp_path, "motorway", "--drivers", "car=cfx://i80-krauss", "--end", "60")
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert int(row[1]) > 50
    assert int(row[4]) > 10  # lane changes
    assert row[5] == "0"  # collisions


def town(folder: Path, policy: str, end: int, step: float) -> None:
    said = drive(
        folder, "town", "--drivers", f"car={policy}", "--end", str(end), "--step", str(step)
    )
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("car"))
    assert int(row[1]) > 0.5 * end
    assert row[5:8] == ["0", "0", "0"]  # contact, gaps below minGap, teleports


def test_the_town_has_no_collisions(tmp_path: Path) -> None:
    """At lights, where left turns give way, and at the roundabout; with SUMO's checks."""
    town(tmp_path, "cfx://i80-w99", 100, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["cfx://i80-w99", "cfx://idm"])
@pytest.mark.parametrize("step", [0.05, 0.1, 0.5, 1.0])
def test_the_town_has_no_collisions_at_any_step(policy: str, step: float, tmp_path: Path) -> None:
    town(tmp_path, policy, 200, step)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.05, 0.1, 0.5, 1.0])
def test_stress_finds_no_collision_and_no_step_outside_the_limits(
    step: float, tmp_path: Path
) -> None:
    """A few events of each kind; the cards hold those of a thousand."""
    script = f"""
import sys
sys.modules["pyarrow"] = None
import json
from cfx_sumo.drive.stress import run_stress
result = run_stress({{"car": "cfx://i80-idm"}}, seed=3, cut_ins=30, step={step})
print(json.dumps(result.to_json()))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=1800
    )
    assert done.returncode == 0, done.stderr
    events = json.loads(done.stdout.splitlines()[-1])["events"]
    assert [event["kind"] for event in events] == [
        "cut-ins",
        "leaders braking at 9 m/s2",
        "standing vehicles",
        "a lane drop",
        "a red light",
    ]
    # Each vehicle that cuts in or brakes is the next ahead of the car, at a gap that was asked for.
    assert events[0]["number"] == 30
    assert events[1]["number"] == 6
    assert 0 < events[0]["headway"][0] < 0.5
    assert 1.0 < events[1]["headway"][0] < events[1]["headway"][2] < 3.0
    assert events[2]["headway"] is None
    assert events[3]["number"] > 100
    for event in events:
        assert event["collisions"] == 0
        assert 0.5 < event["hardest_braking"] <= 9.0 + 1e-6
        assert event["hardest_acceleration"] <= 2.6 + 1e-6
        assert event["smallest_gap"] > 0


def test_without_a_window_gui_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from cfx.app.cli import main
    from cfx_sumo.drive import run as driving

    monkeypatch.setitem(sys.modules, "pyarrow", sys.modules.get("pyarrow"))
    monkeypatch.setitem(sys.modules, "sumo", None)
    monkeypatch.setattr(driving.shutil, "which", lambda _: None)
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
