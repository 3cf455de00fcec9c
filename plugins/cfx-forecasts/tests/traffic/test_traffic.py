"""The protocol `traffic`: what a job leaves of it, and what it refuses."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import cfx
from cfx.errors import CfxError
from cfx_forecasts.traffic.summary import TRAFFIC_METHODS
from cfx_forecasts.traffic.tables import (
    GROWTH_COLUMNS,
    PATH_COLUMNS,
    ROAD_COLUMNS,
    STRIP_COLUMNS,
    Roads,
)
from tests.evaluation.protocols.test_across_drivers import QUICK

TRAFFIC = [
    *QUICK,
    "protocol=traffic",
    "protocol.folds=2",
    "protocol.histories=[]",
    "protocol.densities=[30,60]",
    "protocol.vehicles=6",
    "protocol.repetitions=2",
    "protocol.demands=[1200]",
    "protocol.bottleneck=[100,200]",
    "protocol.leader_speeds=[8]",
    "protocol.platoon=4",
    "protocol.duration=40",
    "protocol.settle=10",
]
CONSTANT = {"pooled", "pooled_ar", "driver_specific", "driver_specific_ar"}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> cfx.plugin.Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("traffic"))
        return cfx.run([*TRAFFIC, "policy=fixed"])


def test_every_method_drives_on_every_road(result: cfx.plugin.Result) -> None:
    roads = pd.read_parquet(result.folder / "traffic.parquet")
    assert list(roads.columns) == list(ROAD_COLUMNS)
    assert set(roads["method"]) == CONSTANT <= set(TRAFFIC_METHODS)
    for _, rows in roads.groupby("method"):
        assert rows["road"].value_counts().to_dict() == {"open": 1, "platoon": 2, "ring": 4}
    rings = roads[roads["road"] == "ring"]
    # Nobody leaves a ring: its density is what was asked for, and its flow that times the speed.
    np.testing.assert_allclose(rings["density"], rings["level"])
    np.testing.assert_allclose(rings["flow"], 3.6 * rings["density"] * rings["speed"])
    notes = json.loads((result.folder / "data.json").read_text())["protocol"]["traffic"]
    assert notes["roads"] == 7
    assert notes["vehicles"] == 4 * 6 + round(1200 * 40 / 3600) + 2 * 4


def test_traffic_stands_in_every_table(result: cfx.plugin.Result) -> None:
    growth = pd.read_parquet(result.folder / "traffic_growth.parquet")
    strips = pd.read_parquet(result.folder / "traffic_strips.parquet")
    paths = pd.read_parquet(result.folder / "traffic_paths.parquet")
    assert list(growth.columns) == list(GROWTH_COLUMNS)
    assert list(strips.columns) == list(STRIP_COLUMNS)
    assert list(paths.columns) == list(PATH_COLUMNS)
    assert set(strips["method"]) == {*CONSTANT, "real"}
    assert bool((growth.loc[growth["vehicle"] == 0, "speed_std"] == 0).all())
    last = growth[(growth["method"] == "driver_specific_ar") & (growth["vehicle"] == 3)]
    value = result.metrics["traffic/growth_last/driver_specific_ar"]
    assert value == pytest.approx(last["speed_std"].item())
    assert value > 0
    # The path of a ring goes around it.
    assert paths["place"].between(0, 6 * 1000 / 60, inclusive="both").all()
    roads = pd.read_parquet(result.folder / "traffic.parquet")
    rings = roads[(roads["method"] == "driver_specific") & (roads["road"] == "ring")]
    capacity = rings.groupby("level")["flow"].mean().max()
    assert result.metrics["traffic/capacity/driver_specific"] == pytest.approx(capacity)
    console = Console(file=io.StringIO(), width=80)
    console.print(*Roads().console(result.evaluation, result.metrics))
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert f"{capacity:.0f}" in shown
    assert "pooled_ar" in shown


def test_the_same_seed_gives_the_same_traffic(
    result: cfx.plugin.Result, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    again = cfx.run([*TRAFFIC, "policy=fixed"])
    for name in ("traffic", "traffic_growth", "traffic_strips", "traffic_paths"):
        one = pd.read_parquet(result.folder / f"{name}.parquet")
        other = pd.read_parquet(again.folder / f"{name}.parquet")
        pd.testing.assert_frame_equal(one, other)


def test_a_stochastic_policy_drives_at_its_centre_and_sampled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    learner = ["learner=rollout", "learner.head=stochastic", "learner.epochs=1", "learner.steps=2"]
    small = ["learner.ensemble_size=1", "learner.horizon=4", "learner.compile=never"]
    monkeypatch.chdir(tmp_path)
    result = cfx.run([*TRAFFIC, "policy=gru", *learner, *small])
    roads = pd.read_parquet(result.folder / "traffic.parquet")
    assert set(roads["method"]) == {*CONSTANT, "policy", "policy_sampled"}
    growth = pd.read_parquet(result.folder / "traffic_growth.parquet")
    followers = growth[growth["vehicle"] > 0].set_index("method")["speed_std"]
    assert not np.allclose(followers["policy"], followers["policy_sampled"], rtol=0.01)


@pytest.mark.parametrize(
    "policy",
    ["policy=recalibrate", "policy=ukf", "policy=particle_filter policy.particles=20"],
)
def test_estimators_drive_too(policy: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("cfx_community", reason="the estimators are cfx-community's")
    monkeypatch.chdir(tmp_path)
    short = ["protocol.duration=12", "protocol.settle=1", "model=idm", "protocol.noise=[2,0.2]"]
    short += ["protocol.densities=[60]", "protocol.repetitions=1", "calibration.prior=none"]
    result = cfx.run([*TRAFFIC, *policy.split(), *short])
    assert np.isfinite(result.metrics["traffic/capacity/policy"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["protocol.densities=[30,400]"], r"400 vehicles/km do not fit"),
        (["protocol.demands=[20000]"], r"20000 vehicles/h do not fit"),
        (["protocol.densities=[]"], "densities"),
        (["protocol.densities=[-1]"], "levels are greater than 0"),
        (["protocol.duration=1e12"], r"protocol.duration=1e\+12 of .* needs about"),
        (["protocol.noise=[0,1]"], "noise is a time constant in s above 0"),
        (["protocol.settle=50"], r"settle=50 s leaves nothing of duration=40 s"),
        (["protocol.bottleneck=[300,200]"], r"bottleneck=\[300, 200\] has to begin after 0"),
        (
            ["model=sumo_vtype", "model.parameters={tau: {low: 0.5, high: 3, default: 1}}"],
            "has equations in sumo only|model=sumo_vtype",
        ),
    ],
)
def test_what_cannot_be_is_refused(
    changes: list[str], message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CfxError, match=message):
        cfx.run([*TRAFFIC, "policy=fixed", *changes])
