"""Multiruns work with the newest release candidate of Hydra too, where `make hydra-next` put it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

NEXT = Path(sys.prefix) / "hydra-next"

SCRIPT = """
import sys, warnings
import hydra
print("Hydra", hydra.__version__)
warnings.filterwarnings("error", module="hydra|omegaconf|cfx")
from cfx.app.application import start
code = start(["-m", "seed=0,1", "hydra.sweep.dir=swept"], target="sweep_stub:run_job")
again = start(["-m", "seed=0,1,2", "hydra.sweep.dir=swept"], target="sweep_stub:run_job")
asked = start(["--config-dir", "mine", "experiment=seeds"], target="sweep_stub:run_job")
sys.exit(max(code, again, asked))
"""

JOB = """
import json
from types import SimpleNamespace
from pathlib import Path

def run_job(config, folder):
    with Path("ran").open("a") as file:
        file.write(f"{config.seed} ")
    (folder / "metrics.json").write_text(json.dumps({"rmse_speed/policy": 1.0}))
    return SimpleNamespace(metrics={"rmse_speed/policy": 1.0})
"""


@pytest.mark.skipif(not NEXT.is_dir(), reason="make hydra-next installs Hydra's next version")
def test_a_sweep_runs_goes_on_and_is_asked_for_by_a_file(tmp_path: Path) -> None:
    (tmp_path / "sweep_stub.py").write_text(JOB)
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "seeds.yaml").write_text(
        "# @package _global_\nhydra: {mode: MULTIRUN, sweeper: {params: {seed: '7,8'}}}\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(NEXT), str(tmp_path)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stdout.startswith("Hydra 1.3"), done.stdout
    assert "continuing" in done.stdout
    assert (tmp_path / "ran").read_text().split() == ["0", "1", "2", "7", "8"]
