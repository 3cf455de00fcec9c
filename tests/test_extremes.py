"""Recordings at the edges of what there is: no number that is none reaches a table without a word.

`test_job.py` has the ordinary ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cfx.app import cli
from cfx.data.pairs import Pair, PairSet
from cfx.data.tidy import write_tidy

LENGTH = 5.0
JOB = (
    "data=tidy",
    "data.min_duration=2",
    "protocol=within_driver",
    "policy=gru",
    "policy.hidden_size=4",
    "learner=imitation",
    "learner.epochs=1",
    "optimizer=random",
    "optimizer.samples=64",
    "cache.enabled=false",
    "tracking.enabled=false",
    "figures=none",
)


def follower(
    name: str,
    frames: int,
    speed: Callable[[np.ndarray], np.ndarray],
    gap: float,
    dt: float = 0.1,
) -> Pair:
    """Returns somebody who does what their leader did a second ago, from a gap, m."""
    leader_speed = speed(np.arange(frames) * dt) + np.zeros(frames)
    ago = round(1 / dt)
    own = np.concatenate([np.full(ago, leader_speed[0]), leader_speed[:-ago]])
    leader, position = way(leader_speed, dt), way(own, dt) - gap - LENGTH
    acceleration = [np.gradient(one, dt) for one in (leader_speed, own)]
    first = (leader, leader_speed, acceleration[0])
    return Pair(name, "r", "1", name, 0, dt, LENGTH, *first, position, own, acceleration[1])


def way(speed: np.ndarray, dt: float) -> np.ndarray:
    steps = (speed[1:] + speed[:-1]) / 2 * dt
    return np.concatenate([[0.0], np.cumsum(steps)])


RECORDINGS = {
    "standstill throughout": [follower(f"p{i}", 150, lambda t: 0 * t, 3.0 + i) for i in range(3)],
    "60 m/s": [
        follower(f"p{i}", 150, lambda t, i=i: 60 + 4 * np.sin(t / (3 + i)), 60.0) for i in range(3)
    ],
    "gaps of 1 cm": [follower(f"p{i}", 75, lambda t: 1 + 0 * t, 0.01) for i in range(3)],
    "an hour": [follower("p", 3_600, lambda t: 15 + 6 * np.sin(t / 7), 30.0, dt=1.0)],
    "an hour in steps of 0.1 s": [follower("p", 36_000, lambda t: 15 + 6 * np.sin(t / 7), 30.0)],
    "one window": [
        follower(f"p{i}", 27, lambda t, i=i: 10 + 2 * np.sin(t / (3 + i)), 20.0) for i in range(2)
    ],
    "two drivers": [
        follower(f"p{i}", 300, lambda t, i=i: 10 + 4 * np.sin(t / (3 + i)), 20.0) for i in range(2)
    ],
}


MODELS = {
    "standstill throughout": "idm",
    "60 m/s": "krauss",
    "gaps of 1 cm": "w99",
    "an hour": "idm",
    "one window": "w99",
    "two drivers": "krauss",
}
"""With what each is tested always; the slow tests try the others."""

CASES = [
    pytest.param(
        recording,
        model,
        marks=[] if model == MODELS.get(recording) else [pytest.mark.slow],
        id=f"{recording}-{model}",
    )
    for recording in RECORDINGS
    for model in ("krauss", "w99", "idm")
]


@pytest.mark.parametrize(("recording", "model"), CASES)
def test_the_edges_of_what_is_recorded(
    recording: str, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "pairs.parquet"
    write_tidy(PairSet(tuple(RECORDINGS[recording]), "test"), path)
    folder = tmp_path / "job"
    job = [*JOB, f"model={model}", f"data.path={path}", f"hydra.run.dir={folder}"]
    if recording.startswith("an hour"):
        job += ["windows.length=50", "windows.stride=50"]  # labels of fewer windows
    if recording == "an hour":
        job += ["calibration.prior=none"]  # it simulates the whole drive another thirty times
    code = cli.main(job)
    out, err = capsys.readouterr()
    assert code == 0, err
    assert "nan" not in out
    metrics = json.loads((folder / "metrics.json").read_text())
    for method in ("default", "driver_specific", "policy"):
        for name in ("rmse_speed", "rmse_gap", "collisions", "jerk"):
            assert np.isfinite(metrics[f"{name}/{method}"]), name
    # What has no value is null, and only where a value makes no sense.
    undefined = {name.split("/")[0] for name, value in metrics.items() if value is None}
    assert undefined <= {"nrmse_speed", "theil_u", "min_ttc", "improvement", "steady"}
    if metrics["improvement/rmse_speed/driver_specific/geometric"] is None:
        assert "Over driver-specific: 3 of 3 pairs have no improvement" in out


def test_the_precision_is_no_part_of_the_result(tmp_path: Path) -> None:
    """In float32 the same job ends within a thousandth of what it ends with in float64."""
    path = tmp_path / "pairs.parquet"
    write_tidy(PairSet(tuple(RECORDINGS["two drivers"]), "test"), path)
    found = {}
    for dtype in ("float32", "float64"):
        folder = tmp_path / dtype
        job = [*JOB, "calibration.prior=weak", f"data.path={path}", f"dtype={dtype}"]
        assert cli.main([*job, f"hydra.run.dir={folder}"]) == 0
        found[dtype] = json.loads((folder / "metrics.json").read_text())
    for method in ("default", "driver_specific"):
        for name in ("rmse_speed", "rmse_gap"):
            single, double = (found[one][f"{name}/{method}"] for one in found)
            assert single == pytest.approx(double, rel=1e-3)
