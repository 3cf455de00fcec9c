"""The same job with either simulator."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import psutil
import pytest

import cfx
from cfx.app.hydra_source import composed, plain
from cfx.app.job.run import run_job
from cfx.errors import CfxError, ConfigError, SumoError
from cfx.results.config import JobConfig
from cfx_sumo import installed
from tests.scripts import ENVIRONMENT

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)
needs_community = pytest.mark.skipif(
    importlib.util.find_spec("cfx_community") is None, reason="the model is cfx-community's"
)

QUICK = [
    "model=krauss",
    "learner=imitation",
    "protocol=within_driver",
    "data=synthetic_short",
    "data.max_pairs=3",
    "optimizer=random",
    "optimizer.samples=12",
    "calibration.prior=weak",
    "policy=fixed",
    "figures=none",
    "tracking.enabled=false",
]


def job(folder: Path, *overrides: str) -> Any:
    values = plain(composed([*QUICK, f"cache.folder={folder.parent / 'cache'}", *overrides]))
    return run_job(JobConfig.of(values), folder)


@needs_sumo
def test_the_table_is_the_same_with_sumo_in_the_loop(tmp_path: Path) -> None:
    same = "model=krauss_sumo"
    memory = job(tmp_path / "memory", same)
    sumo = job(tmp_path / "sumo", same, "simulator=sumo", "simulator.followers=8")
    # Slices of the loss, which flatness is read from, are not simulated in SUMO.
    slices = [name for name in memory.pairs if name.startswith("flat_")]
    assert slices
    expected = memory.pairs.drop(columns=slices)
    pd.testing.assert_frame_equal(sumo.pairs, expected, rtol=0, atol=1e-9)
    assert len(list((tmp_path / "cache").rglob("*.entry"))) == 2 * 3, (
        "each simulator has its own results in the cache"
    )


@needs_sumo
def test_any_model_of_sumo_is_calibrated_by_its_name(tmp_path: Path) -> None:
    own = (
        "model.parameters={tau: {low: 0.5, high: 3, default: 1},"
        " accel: {low: 0.5, high: 4, default: 2}}"
    )
    result = job(
        tmp_path / "eidm",
        "model=sumo_vtype",
        own,
        "model.attributes={treaction: 0.6}",
        "simulator=sumo",
    )
    fixed = result.pairs[result.pairs["method"] == "driver_specific"]
    assert fixed["rmse_speed"].between(0.0, 5.0).all()
    assert fixed["parameter_tau"].between(0.5, 3.0).all()


@needs_sumo
@pytest.mark.parametrize(
    ("how", "code"),
    [(signal.SIGTERM, 143), pytest.param(signal.SIGKILL, -9, marks=pytest.mark.slow)],
)
def test_a_signal_ends_a_calibration_in_sumo_and_its_processes(
    how: signal.Signals, code: int, tmp_path: Path
) -> None:
    several_shards = ["data.max_pairs=8", "optimizer.samples=4096", "simulator.memory_mb=16"]
    sumo = ["model=krauss_sumo", "simulator=sumo", "cache.enabled=false", "hydra.run.dir=job"]
    job = subprocess.Popen(
        [sys.executable, "-m", "cfx", *QUICK, *several_shards, *sumo],
        cwd=tmp_path,
        env=ENVIRONMENT | {"TMPDIR": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("cfx-sumo-*/*/*.rou.xml")) and time.monotonic() < deadline:
        time.sleep(0.1)
    processes = [int(own.name) for own in tmp_path.glob("cfx-sumo-*/*")]
    assert processes, "SUMO simulates"
    os.kill(job.pid, how)
    _, said = job.communicate(timeout=60)
    assert job.returncode == code
    assert "memory" not in said
    while any(map(psutil.pid_exists, processes)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(psutil.pid_exists, processes))
    assert not list(tmp_path.glob("cfx-sumo-*"))


@needs_sumo
def test_a_calibration_in_sumo_asks_no_learner_for_gradients(tmp_path: Path) -> None:
    """Nothing is learned, so the default learner, which needs them, does as well as any."""
    small = ["data.max_pairs=1", "optimizer.samples=2", "learner=rollout_short"]
    result = job(tmp_path / "job", "model=krauss_sumo", "simulator=sumo", *small)
    assert result.pairs["rmse_speed"].notna().all()
    with pytest.raises(ConfigError, match="this learner needs gradients"):
        job(tmp_path / "gru", "model=krauss_sumo", "simulator=sumo", "policy=gru", *small)


@needs_sumo
def test_the_preset_of_eidm_is_what_sumo_knows(tmp_path: Path) -> None:
    result = job(
        tmp_path / "eidm", "model=eidm", "simulator=sumo", "data.max_pairs=1", "optimizer.samples=2"
    )
    assert {"parameter_treaction", "parameter_jerkmax"} <= set(result.pairs.columns)


@needs_sumo
@pytest.mark.slow
def test_a_policy_that_learned_drives_w99_in_sumo(tmp_path: Path) -> None:
    same = ["model=w99", "policy=gru", "learner.epochs=1"]
    memory = job(tmp_path / "memory", *same)
    sumo = job(tmp_path / "sumo", *same, "simulator=sumo")
    columns = ["pair_id", "method", "rmse_speed"]
    both = sumo.pairs[columns].merge(memory.pairs[columns], on=["pair_id", "method"])
    assert len(both) == 9
    assert both["rmse_speed_x"].notna().all()


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (
            ["model=sumo_vtype", "model.parameters={tau: {low: 0.5, high: 3, default: 1}}"],
            "add simulator=sumo",
        ),
        pytest.param(
            ["model=w74", "simulator=sumo"],
            "SUMO has no car-following model W74",
            marks=[needs_sumo, needs_community],
        ),
        (
            ["simulator=sumo", "simulator.workers=0"],
            "simulator.workers=0: should be greater than or equal to 1",
        ),
        (["simulator.name=somu"], "there is no simulator 'somu'. Did you mean 'sumo'?"),
    ],
)
def test_a_combination_that_cannot_be_leaves_nothing(
    overrides: list[str], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(CfxError) as error:
        job(tmp_path / "job", *overrides)
    assert sentence in str(error.value)
    assert not (tmp_path / "job").exists()


def test_without_sumo_nothing_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installed, "BELOW", (1, 0))  # as if another version were needed
    with pytest.raises(SumoError, match=r"pip install .*cfx-sumo$"):
        job(tmp_path / "job", "model=krauss_sumo", "simulator=sumo")
    assert not (tmp_path / "job").exists()


def test_a_learner_that_needs_gradients_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs gradients, and the simulator has none"):
        cfx.run(
            [
                *QUICK[3:],
                "policy=gru",
                "simulator=sumo",
                "model=krauss_sumo",
                "learner=rollout",
                f"hydra.run.dir={tmp_path}",
            ]
        )
    assert not (tmp_path / "config.yaml").exists()
