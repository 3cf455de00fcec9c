"""One job made of the example's components, and what may be done with it afterwards."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cfx.plugin import main

COMPONENTS = (
    "model=helly simulator=mean_speed engine=thread_pool objective=gap_mae optimizer=halton_search"
    " optimizer.samples=64 calibration.prior=weak calibration.posterior=abc_rejection"
    " policy=linear_map learner=best_of_quick"
    " learner.epochs=2 protocol=first_part metrics=[own,time_gap] tables=[own,speed_bins] demo=ranking"
    " tracking.name=run_list"
)


def recording(path: Path) -> Path:
    """Writes two followers who do as their leader did 1.5 s before, 5 m further back."""
    time = 0.1 * np.arange(400)
    parts = []
    for name, start in (("a", 0.0), ("b", 3.0)):
        ahead, behind = time + start, time + start - 1.5
        columns = {
            "pair": name,
            "time_s": time,
            "leader_x_m": 10.0 * ahead - 4.0 * np.cos(0.5 * ahead),
            "leader_v_mps": 10.0 + 2.0 * np.sin(0.5 * ahead),
            "follower_x_m": 10.0 * behind - 4.0 * np.cos(0.5 * behind) - 5.0,
            "follower_v_mps": 10.0 + 2.0 * np.sin(0.5 * behind),
        }
        parts.append(pd.DataFrame(columns))
    pd.concat(parts).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished job."""
    home = tmp_path_factory.mktemp("example")
    data = recording(home / "recording.csv")
    words = (
        f"data=pair_csv data.path={data} data.min_duration=10 tracking.uri={home / 'runs.jsonl'}"
    )
    assert main([*COMPONENTS.split(), *words.split(), f"hydra.run.dir={home / 'job'}"]) == 0
    return home / "job"


def test_what_the_job_measured_is_in_its_folder(job: Path) -> None:
    metrics = json.loads((job / "metrics.json").read_text())
    assert metrics["rmse_gap/policy"] > 0
    assert metrics["time_gap/policy"] > 0
    assert metrics["speed_bins/highest"] == pytest.approx(12.0, abs=0.1)
    assert pd.read_parquet(job / "speed_bins.parquet")["frames"].sum() == 800
    assert "median_t_gap" in pd.read_parquet(job / "fits.parquet")
    assert "<li>" in (job / "ranking" / "demo.html").read_text()


def test_its_run_says_that_it_finished(job: Path) -> None:
    last = json.loads((job.parent / "runs.jsonl").read_text().splitlines()[-1])
    assert last["status"] == "finished"
    assert last["folder"] == str(job)


def test_other_commands_read_it(job: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gains", str(job)]) == 0
    assert capsys.readouterr().out.startswith(f"{job}: ")
    assert main(["export", str(job), "--to", "driver_json"]) == 0
    assert set(json.loads((job / "driver_json.json").read_text())) == {"a", "b"}


def test_a_recurrent_policy_drives_with_its_head(job: Path) -> None:
    words = "model=helly optimizer=random optimizer.samples=32 policy=gru learner.head=nearby"
    words += " calibration.prior=weak learner.epochs=1 data.pairs=2 data.frames=400"
    words += " protocol.folds=2 tracking.enabled=false"
    assert main([*words.split(), f"hydra.run.dir={job.parent / 'headed'}"]) == 0
    policy = json.loads((job.parent / "headed" / "policy" / "policy.json").read_text())
    assert "nearby" in json.dumps(policy)
