"""A sweep that is killed at random moments ends complete and identical when it is begun again.

`make kills` kills a hundred times with each launcher (`CFX_KILLS`); `make test-slow` a few times.
"""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

KILLS = int(os.environ.get("CFX_KILLS", "4"))
AT_MOST = 4
"""Kills of one sweep; then it may end."""

LAUNCHERS = {
    "basic": (),
    "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
}

pytestmark = [pytest.mark.slow, pytest.mark.timeout(0)]


def command(folder: Path, launcher: tuple[str, ...]) -> list[str]:
    return [
        *(sys.executable, "-m", "cfx", "-m", "debug=quick", "figures=all", "seed=1,2,3"),
        *launcher,
        f"hydra.sweep.dir={folder / 'sweep'}",
        f"cache.folder={folder / 'cache'}",
        f"tracking.uri=sqlite:///{folder / 'mlflow.db'}",
    ]


def sweep(folder: Path, launcher: tuple[str, ...], kill_after: float | None) -> int | None:
    """Returns the exit code; None: the sweep and all its processes were killed."""
    folder.mkdir(exist_ok=True)
    with (folder / "said").open("w") as said:
        process = subprocess.Popen(
            command(folder, launcher),
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            return process.wait(kill_after)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return None


def results(folder: Path) -> list[bytes]:
    return sorted(path.read_bytes() for path in (folder / "sweep").rglob("metrics.json"))


def runs(folder: Path) -> dict[str, int]:
    """Returns the number of MLflow's runs by status."""
    with sqlite3.connect(folder / "mlflow.db") as store:
        query = "SELECT status, COUNT(*) FROM runs WHERE lifecycle_stage='active' GROUP BY status"
        return dict(store.execute(query).fetchall())


def temporary_files(folder: Path) -> list[Path]:
    return [path for path in (folder / "sweep").rglob(".*") if path.name[1:2].isdigit()]


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_killed_sweep_ends_complete_and_identical(launcher: str, tmp_path: Path) -> None:
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs hydra-joblib")
    overrides, moments = LAUNCHERS[launcher], np.random.default_rng(0)
    whole = tmp_path / "whole"
    began = time.monotonic()
    assert sweep(whole, overrides, None) == 0
    lasts = time.monotonic() - began
    expected, finished = results(whole), runs(whole)
    assert len(expected) == 3
    assert set(finished) == {"FINISHED"}
    kills, sweeps = 0, 0
    while kills < KILLS:
        folder = tmp_path / "killed"
        for _ in range(min(AT_MOST, KILLS - kills)):
            if sweep(folder, overrides, moments.uniform(0.3, lasts)) is not None:
                break
            kills += 1
        code = sweep(folder, overrides, None)
        said = (folder / "said").read_text()[-2000:]
        assert code == 0, said
        assert results(folder) == expected, said
        assert "RUNNING" not in runs(folder), said
        assert runs(folder)["FINISHED"] == finished["FINISHED"], runs(folder)
        assert not temporary_files(folder)
        shutil.rmtree(folder)
        sweeps += 1
    print(f"{launcher}: {kills} kills of {sweeps} sweeps, 0 that ended otherwise")
