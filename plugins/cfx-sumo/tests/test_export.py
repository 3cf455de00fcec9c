from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import yaml

import cfx
from cfx.app.cli import main
from cfx.core.registry import create
from cfx.errors import ConfigError, DataError, OutputError
from cfx.models.base import DrivingModel
from cfx_sumo.demo.motorway import SHIPPED
from cfx_sumo.export import export
from cfx_sumo.simulation.network import network

CALIBRATED = (
    "policy=fixed",
    "protocol=within_driver",
    "data=synthetic",
    "data.pairs=3",
    "data.frames=150",
    "optimizer=random",
    "optimizer.samples=32",
    "calibration.prior=weak",
    "figures=none",
    "tracking.enabled=false",
    "hydra.run.dir=job",
)
"""A job that calibrates three drivers."""

CLUSTERS = ("conservative", "normal", "normal", "aggressive")


def job(folder: Path, node: dict[str, Any], shift: float = 0.1) -> Path:
    """Writes what a finished job leaves: four pairs with parameters between the bounds."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"model": node}))
    (folder / "policy").mkdir(exist_ok=True)
    (folder / "policy" / "policy.json").write_text('{"dt": 0.1}')
    model = create("model", node)
    assert isinstance(model, DrivingModel)
    low, high = (bound.tolist() for bound in model.space.bounds())
    rows = []
    for k, cluster in enumerate(CLUSTERS):
        for method in ("default", "driver_specific", "policy"):
            share = shift * (k + 1) if method == "driver_specific" else 0.9
            values = {
                f"parameter_{n}": a + share * (b - a)
                for n, a, b in zip(model.space.names, low, high, strict=True)
            }
            rows.append(
                {
                    "pair_id": f"p<{k}>",
                    "cluster": cluster,
                    "style_score": 0.2 * k,
                    "method": method,
                    **values,
                }
            )
    pd.DataFrame(rows[::-1]).to_csv(folder / "pairs.csv", index=False)
    return folder


def types(path: Path) -> dict[str, dict[str, dict[str, str]]]:
    root = ElementTree.parse(path).getroot()  # noqa: S314 - we have just written it
    return {
        one.get("id", ""): {kind.get("id", ""): dict(kind.attrib) for kind in one.iter("vType")}
        for one in root.iter("vTypeDistribution")
    }


def test_each_cluster_is_a_distribution_of_its_drivers_own_fixed_parameters(tmp_path: Path) -> None:
    folder = job(tmp_path / "w99", {"name": "w99"})
    lines = export(folder)
    assert lines[0].endswith("conservative 1, normal 2, aggressive 1; all together in 'drivers'")
    found = types(folder / "drivers.add.xml")
    assert {cluster: len(kinds) for cluster, kinds in found.items()} == {
        "conservative": 1,
        "normal": 2,
        "aggressive": 1,
        "drivers": 0,
    }
    table = (
        pd.read_csv(folder / "pairs.csv")
        .query("method == 'driver_specific'")
        .sort_values("style_score")
        .reset_index()
    )
    for row, kind in enumerate(one for kinds in found.values() for one in kinds.values()):
        assert kind["carFollowModel"] == "W99"
        assert float(kind["cc1"]) == table["parameter_cc1"][row]
        assert float(kind["minGap"]) == table["parameter_cc0"][row]
    text = (folder / "drivers.add.xml").read_text()
    assert 'key="pair" value="p&lt;0&gt;"' in text


def test_what_parameters_belong_to_and_sumo_lacks_is_said(tmp_path: Path) -> None:
    node = {"name": "idm", "limits": {"response_time": 0.3, "emergency_deceleration": 8.0}}
    folder = job(tmp_path / "idm", node)
    lines = export(folder)
    (lost,) = [line for line in lines if "knows nothing of" in line]
    assert "model.limits.response_time=0.3" in lost
    assert "emergency_deceleration=8" not in lost  # IDM's vType carries it
    assert any("the parameters belong to steps of 0.1 s" in line for line in lines)
    assert not any("steps so coarse" in line for line in lines)
    policy = folder / "policy" / "policy.json"
    policy.write_text(policy.read_text().replace('"dt": 0.1', '"dt": 1.0'))
    assert any("steps so coarse" in line for line in export(folder))
    assert "response_time=0.3" in (folder / "drivers.add.xml").read_text()


def test_krauss_loses_its_brake_build_up_time_and_says_so(tmp_path: Path) -> None:
    folder = job(tmp_path / "krauss", {"name": "krauss"})
    lines = export(folder, tmp_path / "here.add.xml")
    assert any(
        line.startswith("Note: SUMO's KraussOrig1 has no brake build-up time t_i; tau is t_r")
        for line in lines
    )
    fixed = pd.read_csv(folder / "pairs.csv").query(
        "method == 'driver_specific' and cluster == 'aggressive'"
    )
    (kind,) = types(tmp_path / "here.add.xml")["aggressive"].values()
    assert (kind["carFollowModel"], float(kind["tau"])) == (
        "KraussOrig1",
        fixed["parameter_t_r"].item(),
    )
    assert not (folder / "drivers.add.xml").exists()
    same = job(
        tmp_path / "without",
        {
            "name": "krauss",
            "variant": "sumo",
            "parameters": {"t_i": {"default": 0.0, "tuned": False}},
        },
    )
    assert not any("KraussOrig1 has no" in line for line in export(same))


def test_new_drivers_of_a_population_keep_their_parameters_together(tmp_path: Path) -> None:
    folder = job(tmp_path / "idm", {"name": "idm"})
    drawn = pd.DataFrame(
        {
            "parameter_v0": [20.0, 30.0, 25.0],
            "parameter_T": [1.0, 1.5, 2.0],
            "parameter_s0": [2.0, 1.0, 3.0],
            "parameter_a": [1.0, 2.0, 0.5],
            "parameter_b": [2.0, 3.0, 1.0],
        }
    )
    drawn.to_parquet(folder / "population.parquet")
    lines = export(folder)
    assert "3 drawn from their population in 'population'" in lines[0]
    found = types(folder / "drivers.add.xml")["population"]
    assert [float(kind["tau"]) for kind in found.values()] == [1.0, 1.5, 2.0]
    assert [float(kind["accel"]) for kind in found.values()] == [1.0, 2.0, 0.5]
    assert [float(kind["minGap"]) for kind in found.values()] == [2.0, 1.0, 3.0]


def test_sumo_loads_it_as_it_is_and_one_vehicle_of_each_type_drives(tmp_path: Path) -> None:
    pytest.importorskip("traci", reason="needs the extra sumo")
    nodes: list[dict[str, Any]] = [
        {"name": name} for name in ("krauss", "w99", "krauss_sumo", "idm_sumo", "idm")
    ]
    for number, node in enumerate(nodes):
        folder = job(tmp_path / str(number), node)
        own = pd.read_csv(folder / "pairs.csv").query("method == 'driver_specific'")
        own.filter(regex="^parameter_").to_parquet(folder / "population.parquet")
        export(folder)
        found = types(folder / "drivers.add.xml")
        new = found.pop("population")
        every = [kind for kinds in found.values() for kind in kinds]
        vehicles = [
            f'<vehicle id="{kind}" type="{kind}" route="m" depart="{i}"/>'
            for i, kind in enumerate(every)
        ]
        vehicles.append('<vehicle id="any" type="normal" route="m" depart="9"/>')
        vehicles.append('<vehicle id="anybody" type="drivers" route="m" depart="12"/>')
        vehicles.append('<vehicle id="new" type="population" route="m" depart="15"/>')
        assert len(new) == len(every)
        (folder / "demand.rou.xml").write_text(
            f'<routes><route id="m" edges="1001"/>{"".join(vehicles)}</routes>'
        )
    script = """
import json, os, sys
os.environ["LIBSUMO_AS_TRACI"] = "quiet"
import libsumo as sumo
answers = []
for k in range(5):
    files = ["-n", sys.argv[1], "-a", f"{k}/drivers.add.xml", "-r", f"{k}/demand.rou.xml"]
    sumo.start(["sumo", *files, "--no-step-log", "--step-length", "0.1"])
    seen = {}
    while sumo.simulation.getMinExpectedNumber():
        sumo.simulationStep()
        for one in sumo.vehicle.getIDList():
            fastest = seen.get(one, ["", 0])[1]
            speed = sumo.vehicle.getSpeed(one)
            seen[one] = [sumo.vehicle.getTypeID(one), max(speed, fastest)]
    sumo.close()
    answers.append(seen)
print(json.dumps(answers))
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(SHIPPED)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    for seen in json.loads(done.stdout):
        assert {name for name, (kind, _) in seen.items() if name == kind} == {
            "conservative_0",
            "normal_0",
            "normal_1",
            "aggressive_0",
        }
        assert seen["any"][0] in {"normal_0", "normal_1"}
        assert seen["new"][0].startswith("population_")
        assert all(fastest > 5 for _, fastest in seen.values())


BEHIND_RECORDED_LEADERS = """
import json, sys
import libsumo as sumo
ahead = json.load(open("ahead.json"))
sumo.start(["sumo", "-n", "road.net.xml", "-a", "job/drivers.add.xml", "-r", "drive.rou.xml",
            "--step-length", "0.1", "--no-step-log", "--collision.action", "none"])
vehicle, speeds = sumo.vehicle, {name: [] for name in ahead}
sumo.simulationStep()
for name, (start, position, speed) in ahead.items():
    for one in ("leader." + name, name):
        vehicle.setLaneChangeMode(one, 0)
    vehicle.setSpeedMode("leader." + name, 0)
    vehicle.setPreviousSpeed("leader." + name, speed[0])
    vehicle.setPreviousSpeed(name, start)
for k in range(1, max(len(position) for _, position, _ in ahead.values())):
    there = {name: one for name, one in ahead.items() if k < len(one[1])}
    for name, (_, position, speed) in there.items():
        vehicle.setSpeed("leader." + name, (position[k] - position[k - 1]) / 0.1)
    sumo.simulationStep()
    for name, (_, position, speed) in there.items():
        vehicle.setPreviousSpeed("leader." + name, speed[k])
        speeds[name].append(vehicle.getSpeed(name))
sumo.close()
print(json.dumps(speeds))
"""


@pytest.mark.parametrize("model", ["idm", "krauss_sumo"])
def test_vtypes_have_in_plain_sumo_the_error_that_the_job_says(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the recorded leaders, from where the test part begins."""
    pytest.importorskip("traci", reason="needs the extra sumo")
    monkeypatch.chdir(tmp_path)
    finished = cfx.run([f"model={model}", *CALIBRATED])
    export(finished.folder)
    drives = pd.read_parquet(finished.folder / "trajectories.parquet").groupby("pair_id")
    data = pd.read_parquet(finished.folder / "data.parquet").set_index(["pair_id", "frame"])
    kinds = {}
    for one in ElementTree.parse(finished.folder / "drivers.add.xml").iter("vType"):  # noqa: S314
        kinds[one[0].attrib["value"]] = one.attrib["id"]
    vehicles: list[str] = []
    ahead: dict[str, tuple[float, list[float], list[float]]] = {}
    recorded: dict[str, list[float]] = {}
    for number, (name, drive) in enumerate(drives):
        seen = data.loc[name].loc[(drive["time_s"] / 0.1).round().astype(int)]
        origin = seen["follower_position_m"].iloc[0] - 100.0
        length = seen["leader_length_m"].iloc[0]
        leader = (seen["leader_position_m"] - origin).tolist()
        start, *recorded[name] = drive["real_speed"].tolist()
        ahead[name] = (start, leader, seen["leader_speed_mps"].tolist())
        vehicles.append(
            f'<vType id="long{number}" length="{length}" maxSpeed="90" speedDev="0"/>'
            f'<route id="r{number}" edges="road{number}"/>'
        )
        for one, kind, at in (
            (f"leader.{name}", f"long{number}", leader[0]),
            (name, kinds[name], 100.0),
        ):
            vehicles.append(
                f'<vehicle id="{one}" type="{kind}" route="r{number}" depart="0" departPos="{at!r}"'
                f' departSpeed="{start!r}" insertionChecks="none"/>'
            )
    Path("road.net.xml").write_text(network(len(ahead)))
    Path("drive.rou.xml").write_text(f"<routes>{''.join(vehicles)}</routes>")
    Path("ahead.json").write_text(json.dumps(ahead))
    done = subprocess.run(
        [sys.executable, "-c", BEHIND_RECORDED_LEADERS],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    speeds = json.loads(done.stdout.splitlines()[-1])
    table = pd.read_csv(finished.folder / "pairs.csv").query("method == 'driver_specific'")
    said = table.set_index("pair_id")["rmse_speed"]
    assert len(said) == 3
    for name, error in said.items():
        difference = np.array(speeds[str(name)]) - recorded[name]
        assert np.sqrt(np.mean(difference**2)) == pytest.approx(error, rel=0.01)


def test_a_model_that_sumo_lacks_is_not_exported(tmp_path: Path) -> None:
    pytest.importorskip("cfx_community", reason="the model is cfx-community's")
    with pytest.raises(
        ConfigError,
        match="SUMO has no car-following model that drives as model=w74; export jobs with model=",
    ):
        export(job(tmp_path / "w74", {"name": "w74"}))


def test_what_cannot_be_exported_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError, match="variant=sumo only"):
        export(job(tmp_path / "vissim", {"name": "w99", "variant": "vissim"}))
    assert main(["export", str(tmp_path), "--to", "sumo"]) == 2
    assert "holds no finished job" in capsys.readouterr().err
    assert main(["export", "cfx://idm", "--to", "sumo"]) == 2
    assert "a ready-made policy has no driver-specific parameters" in capsys.readouterr().err
    folder = job(tmp_path / "job", {"name": "w99"})
    with pytest.raises(OutputError, match="name another --output"):
        export(folder, folder / "config.yaml" / "x.add.xml")
    table = pd.read_csv(folder / "pairs.csv")
    table[table["method"] == "policy"].to_csv(folder / "pairs.csv", index=False)
    with pytest.raises(DataError, match="no driver-specific parameters"):
        export(folder)
    table.drop(columns="parameter_cc3").to_csv(folder / "pairs.csv", index=False)
    with pytest.raises(DataError, match="no column parameter_cc3"):
        export(folder)
    assert not list(tmp_path.rglob("*.add.xml"))


def test_the_command_says_how_to_use_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = job(tmp_path / "job", {"name": "w99"})
    path = tmp_path / "my [x].add.xml"
    assert main(["export", str(folder), "--to", "sumo", "--output", str(path)]) == 0
    assert (
        f"sumo --step-length 0.1 --additional-files '{path}'; then in a flow or vehicle:"
        ' type="drivers", or type="conservative"' in capsys.readouterr().out
    )
