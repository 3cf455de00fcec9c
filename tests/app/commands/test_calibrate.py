"""`cfx calibrate FILE` is a job that calibrates: it speaks of no policy, in its sweep neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.app import cli
from cfx.app.commands.calibrate import overrides_of
from cfx.data.tidy import write_tidy
from cfx.errors import ConfigError
from cfx.simulation.synthetic import SyntheticDataset

QUICK = [
    "data.min_duration=10",
    "optimizer=random",
    "optimizer.samples=16",
    "calibration.prior=none",
    "tracking.enabled=false",
    "figures=none",
]


@pytest.fixture
def pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "pairs.parquet"
    write_tidy(SyntheticDataset(pairs=4, frames=300, min_duration=10).load(), path)
    return path


def test_a_calibration_and_a_sweep_of_models_speak_of_no_policy(
    pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(pairs), "-m", "model=idm,krauss", *QUICK, "hydra.sweep.dir=sweep"]
    assert cli.main(["calibrate", *words]) == 0
    printed = capsys.readouterr().out
    said = [line for line in printed.splitlines() if not line.lstrip().startswith("#")]
    assert "policy" not in "\n".join(said).lower()  # Hydra lists each job's settings
    assert "learner" not in printed
    assert "driver-specific" in printed
    assert "fitted" in printed
    assert "Closest to the drivers: model=" in printed
    header = Path("sweep/summary.csv").read_text().partition("\n")[0]
    assert "policy" not in header
    assert "improvement" not in header
    assert "rmse_gap" in header.split(",")
    assert len(list(Path("sweep").glob("*/fits.parquet"))) == 2


def test_files_and_settings_become_the_job_that_the_command_line_runs(pairs: Path) -> None:
    other = pairs.with_name("other one.parquet")
    other.write_bytes(pairs.read_bytes())
    assert overrides_of([str(pairs), "model=idm"]) == [
        "policy=fixed",
        "protocol=within_driver",
        "data=tidy",
        f"data.path={pairs}",
        "model=idm",
    ]
    several = overrides_of([str(pairs), str(other), "protocol=across_drivers", "data=tidy"])
    assert several == [
        "policy=fixed",
        f"data.path=[{pairs},'{other}']",
        "protocol=across_drivers",
        "data=tidy",
    ]
    own = overrides_of(["absent.csv", "data.columns.speed=v"])
    assert own[2:] == ["data=tidy", "data.path=absent.csv", "data.columns.speed=v"]


def test_a_setting_of_pooled_parameters_is_refused_where_none_are_calibrated(
    pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(pairs), *QUICK, "calibration.pooled_segment_s=5"]
    assert cli.main(["calibrate", *words]) == 2
    assert "calibration.pooled_segment_s=5: this job calibrates no pooled parameters" in (
        capsys.readouterr().err
    )


def test_a_policy_to_train_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"trains no policy: leave policy=gru out"):
        overrides_of(["pairs.csv", "policy=gru"])


def test_whole_trajectories_are_calibrated_on_and_nothing_is_called_a_test(
    pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(pairs), "model=idm", "split=1", *QUICK, "hydra.run.dir=job"]
    assert cli.main(["calibrate", *words]) == 0
    printed = capsys.readouterr().out
    assert "all of what was calibrated on" in printed
    assert "fitted" not in printed
    fits = pd.read_parquet("job/fits.parquet").query("method == 'driver_specific'")
    assert not [name for name in fits if name.startswith("test_")]
    table = pd.read_csv("job/pairs.csv").query("method == 'driver_specific'")
    assert set(table["frames"]) == {299}
    np.testing.assert_allclose(fits["train_rmse_speed"], table["rmse_speed"])


@pytest.mark.parametrize(
    "words", ["policy=fixed protocol=across_drivers protocol.folds=2", "protocol=within_driver"]
)
def test_what_tests_needs_a_test_part(
    pairs: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    common = ["data=tidy", f"data.path={pairs}", "split=1", *QUICK]
    assert cli.main([*common, *words.split()]) == 2
    assert "split=1 leaves nothing to be tested" in capsys.readouterr().err
