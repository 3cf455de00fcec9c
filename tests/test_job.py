"""Whole jobs: what they leave behind, that they repeat, and what they say of mistakes."""

from __future__ import annotations

import json
import math
import os
import sqlite3
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

import cfx
from cfx.app import cli
from cfx.app.job import steps
from cfx.core import registry
from cfx.data.pairs import PairSet
from cfx.data.tidy import write_tidy
from cfx.errors import DataError
from cfx.policies.prediction import predict_frame
from cfx.simulation.synthetic import SyntheticDataset
from tests.checkout import needs

QUICK = [
    "debug=quick",
    "data.pairs=3",
    "data.platoon_size=1",
    "data.frames=200",
    "data.max_pairs=null",
    "figures=none",
    "tracking.enabled=false",
    "calibration.prior=none",
]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


def run(*overrides: str) -> cfx.plugin.Result:
    return cfx.run([*QUICK, *overrides])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> cfx.plugin.Result:
    """A job with everything on, by the command line."""
    folder = tmp_path_factory.mktemp("job")
    everything = ["debug=quick", "data.pairs=3", "data.frames=200", "data.max_pairs=null"]
    with (
        pytest.MonkeyPatch.context() as patch,
        (folder / "stdout.txt").open("w") as out,
        (folder / "stderr.txt").open("w") as error,
        redirect_stdout(out),
        redirect_stderr(error),
    ):
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        assert cli.main([*everything, "hydra.run.dir=out"]) == 0
    return cfx.load(folder / "out")


def test_the_folder_holds_what_the_contract_says(finished: cfx.plugin.Result) -> None:
    folder = finished.folder
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert {
        "config.yaml",
        "metrics.json",
        "pairs.csv",
        "policy/policy.safetensors",
        "policy/policy.json",
        "cfx.log",
    } <= names
    assert {path.name for path in finished.figures} == {
        "drives.png",
        "chosen_parameters.png",
        "improvement_per_driver.png",
        "learning_curve.png",
    }
    assert not [name for name in names if Path(name).name.startswith(".")]
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["model"]["name"] == "krauss"
    assert config["learner"]["epochs"] == 3
    metrics = json.loads((folder / "metrics.json").read_text())
    expected = {
        f"{what}/{method}"
        for what in ("rmse_speed", "rmse_gap")
        for method in ("default", "driver_specific", "policy")
    }
    expected |= {
        f"improvement/rmse_speed/driver_specific/{name}"
        for name in (
            "geometric",
            "ratio_of_means",
            "mean_ratio",
            "trimmed_mean_ratio",
            "median",
            "drivers",
            "ci95_low",
            "ci95_high",
            "win_rate",
            "p_value",
        )
    }
    assert expected | {"collisions/policy"} <= set(metrics)


def test_the_terminal_says_what_matters(finished: cfx.plugin.Result) -> None:
    text = (finished.folder.parent / "stdout.txt").read_text()
    for word in (
        "default",
        "driver-specific",
        "policy",
        "RMSE",
        "policy better by %",
        "In short: ",
        "Results:",
        "cfx ui",
        "http://127.0.0.1:5000",
    ):
        assert word in text, text
    assert "Traceback" not in (finished.folder.parent / "stderr.txt").read_text()


def test_a_row_per_pair_and_method(finished: cfx.plugin.Result) -> None:
    assert len(finished.pairs) == 9
    means = finished.pairs.groupby("method").rmse_speed.mean()
    for method in ("default", "driver_specific", "policy"):
        assert finished.metrics[f"rmse_speed/{method}"] == pytest.approx(means[method])


def test_every_window_has_its_label_and_spread(finished: cfx.plugin.Result) -> None:
    labels = pd.read_parquet(finished.folder / "labels.parquet")
    # 200 frames are 39 windows of 5 steps, of which the first 80 % are calibrated.
    assert labels.groupby("pair_id").size().tolist() == [31, 31, 31]
    assert {"time_s", "parameter_t_r", "parameter_t_i", "loss", "sensitivity"} <= set(
        labels.columns
    )
    assert bool((labels.sensitivity >= 0).all())
    assert finished.metrics["labels/loss"] == pytest.approx(labels.loss.mean())


def test_a_calibration_says_its_objective_and_reports_the_others(
    finished: cfx.plugin.Result,
) -> None:
    described = json.loads((finished.folder / "data.json").read_text())
    assert described["objective"] == {"name": "speed_rmse", "unit": "m/s"}
    for entry in registry.entries("objective"):
        if entry.distribution != "cfx-driving":
            continue
        name = entry.name
        assert finished.metrics[f"calibration/{name}/driver_specific"] >= 0, name


def test_another_objective_calibrates_other_parameters() -> None:
    search = ["policy=fixed", "optimizer.samples=1024"]
    speed = run(*search, "objective=speed_rmse")
    gap = run(*search, "objective=gap_rmse")
    for name, better, worse in (("speed_rmse", speed, gap), ("gap_rmse", gap, speed)):
        metric = f"calibration/{name}/driver_specific"
        assert better.metrics[metric] < worse.metrics[metric], name


def test_synthetic_data_keeps_its_truth(finished: cfx.plugin.Result) -> None:
    table = pd.read_parquet(finished.folder / "data.parquet")
    assert {"true_t_r", "true_t_i", "true_model"} <= set(table.columns)


@pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:sqlalchemy.exc.SADeprecationWarning"
)  # inside MLflow
@pytest.mark.filterwarnings(
    "ignore:.*Any type hint is inferred as AnyType:UserWarning"
)  # inside MLflow, at its import
def test_the_policy_in_mlflow_predicts_the_same(
    finished: cfx.plugin.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlflow

    home = finished.folder.parent
    uri = f"sqlite:///{home}/outputs/mlflow.db"
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("cfx-debug")
    assert experiment is not None
    (tracked,) = client.search_runs([experiment.experiment_id])
    assert tracked.info.status == "FINISHED"
    assert tracked.data.metrics["rmse_speed_driver_specific_mps"] == pytest.approx(
        finished.metrics["rmse_speed/driver_specific"], abs=5e-4
    )
    assert tracked.data.params["model"] == "krauss"
    before = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(uri)
    try:
        (model,) = client.search_logged_models([experiment.experiment_id])
        served = mlflow.pyfunc.load_model(f"models:/{model.model_id}")
    finally:
        mlflow.set_tracking_uri(before)
        os.environ.pop("MLFLOW_TRACKING_URI", None)  # MLflow sets it too
    table = pd.read_parquet(finished.folder / "data.parquet")
    pd.testing.assert_frame_equal(served.predict(table), predict_frame(finished.policy, table))
    monkeypatch.chdir(home)
    again = cfx.load(tracked.info.run_id)
    assert again.metrics == finished.metrics


@pytest.mark.parametrize(
    "overrides",
    [["model=w99", "policy=lstm"], ["model=helly", "protocol.networks=all"], ["dtype=float32"]],
)
def test_other_components_run_too(overrides: list[str]) -> None:
    result = run(*overrides)
    assert all(
        math.isfinite(result.metrics[f"rmse_speed/{method}"])
        for method in ("default", "driver_specific", "policy")
    )
    loaded = cfx.load(result.folder)
    table = pd.read_parquet(result.folder / "data.parquet")
    pd.testing.assert_frame_equal(
        predict_frame(loaded.policy, table), predict_frame(result.policy, table)
    )


def test_two_policies_calibrate_once_and_a_seed_gives_the_same_metrics(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level("INFO"):
        one = run("policy=gru")
        first = [message for message in caplog.messages if "problems" in message]
        caplog.clear()
        run("policy=lstm")
    assert any("(labels)" in message for message in first)
    assert not [
        message
        for message in caplog.messages
        if "problems): done" in message and "0 problems" not in message
    ]
    two, other = run("cache.enabled=false"), run("seed=1", "cache.enabled=false")
    texts = [(result.folder / "metrics.json").read_text() for result in (one, two, other)]
    assert one.folder != two.folder
    assert texts[0] == texts[1], "cached or not"
    assert texts[0] != texts[2]


def selected(**settings: object) -> PairSet:
    """Returns the pairs that a job with these settings calibrates."""
    synthetic: dict[str, Any] = {"data": "synthetic", "data.pairs": 8, "data.platoon_size": 1}
    config = cfx.config(**synthetic, **settings).config
    pairs, _ = steps.select_pairs(cfx.Pairs.of(config.data).selected, config)
    return pairs


def test_other_time_steps_are_said_and_can_be_brought_to_the_usual_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    fine = {"data.dt": 0.04, "data.frames": 500, "data.min_duration": 20}
    with caplog.at_level("INFO"):
        selected(**fine)
        assert any(
            "5 steps lasts 0.2 s" in message and "data.time_step=0.1" in message
            for message in caplog.messages
        )
        caplog.clear()
        pairs = selected(**fine, **{"data.time_step": 0.1})
    assert not any("data.time_step" in message for message in caplog.messages)
    assert pairs.dt == 0.1


def test_a_coarse_time_step_is_warned_of_with_the_remedy(
    caplog: pytest.LogCaptureFixture,
) -> None:
    coarse = {"data.dt": 0.5, "data.frames": 120}
    selected(**coarse, **{"data.min_duration": 25})
    assert any("parameters calibrated in such steps are biased" in one for one in caplog.messages)
    caplog.clear()
    selected(**coarse, **{"data.time_step": 0.1, "data.min_duration": 20})
    assert not any("biased" in message for message in caplog.messages)


def test_a_style_cluster_is_selected() -> None:
    assert len(selected(**{"style.cluster": "normal", "data.frames": 200})) == 4


@needs("cfx-recordings")
def test_the_raw_sample_is_found(shared_data: Path) -> None:
    pairs = cfx.read(shared_data / "i80_0400_raw_sample.csv.gz", min_duration=30)
    assert (pairs.node["name"], len(pairs)) == ("ngsim", 142)


# ---- bad input: one sentence, exit code 2, nothing lost


@pytest.fixture
def tidy(tmp_path: Path) -> Path:
    path = tmp_path / "pairs.csv"
    write_tidy(SyntheticDataset(pairs=2, frames=120).load(), path)
    return path


Change = Callable[[pd.DataFrame], pd.DataFrame]


def _set(row: int, column: str, value: object) -> Change:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        table = table.astype({column: object})
        table.loc[row, column] = value
        return table

    return change


BROKEN_TABLES: dict[str, tuple[Change, str]] = {
    "wrong column": (
        lambda t: t.rename(columns={"leader_speed_mps": "leader_sped_mps"}),
        "leader_speed_mps",
    ),
    "NaN": (_set(7, "follower_speed_mps", math.nan), "follower_speed_mps"),
    "infinite": (_set(7, "leader_position_m", math.inf), "leader_position_m"),
    "text": (_set(7, "leader_position_m", "far"), "leader_position_m"),
    "duplicate": (lambda t: pd.concat([t, t.iloc[[5]]]), "frame"),
    "gap in frames": (lambda t: t.drop(index=50), "frame"),
    "leader behind": (_set(9, "leader_position_m", -1e4), "behind"),
    "negative speed": (_set(9, "leader_speed_mps", -3.0), "leader_speed_mps"),
    "wrong unit": (
        lambda t: t.assign(**{c: t[c] * 3.6 for c in ("leader_speed_mps", "follower_speed_mps")}),
        "km/h",
    ),
    "no rows": (lambda t: t.iloc[:0], "pairs.csv"),
}


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Runs the program on a user's mistake; returns its one message."""
    data = [] if "data=tidy" in arguments else QUICK[1:4]
    code = cli.main([*data, *QUICK[4:], "optimizer=random", "optimizer.samples=8", *arguments])
    captured = capsys.readouterr()
    assert code == 2, captured
    assert "Traceback" not in captured.err + captured.out
    message = captured.err.strip()
    assert message
    return message


def unread(dataset: str, path: Path, **settings: object) -> str:
    """Returns what a dataset says of a file, which the program prints as of any mistake."""
    with pytest.raises(DataError) as told:
        registry.create("dataset", {"name": dataset, "path": str(path), **settings}).load()
    return str(told.value)


@pytest.mark.parametrize("name", BROKEN_TABLES)
def test_a_broken_table_is_told(name: str, tidy: Path) -> None:
    change, expected = BROKEN_TABLES[name]
    change(pd.read_csv(tidy)).to_csv(tidy, index=False)
    message = unread("tidy", tidy, min_duration=5)
    assert expected in message
    assert "pairs.csv" in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.csv", None),
        ("empty.csv", b""),
        ("binary.csv", bytes(range(256)) * 9),
        ("cut.parquet", b"PAR1\x15\x04"),
        ("cut.csv.gz", b"\x1f\x8b\x08\x00abc"),
    ],
)
@pytest.mark.parametrize("dataset", ["tidy", pytest.param("ngsim", marks=needs("cfx-recordings"))])
def test_an_unreadable_file_is_told(
    name: str,
    content: bytes | None,
    dataset: str,
    tmp_path: Path,
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert name in unread(dataset, tmp_path / name)


def test_a_wrong_separator_is_told(tidy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tidy.write_text(tidy.read_text().replace(",", ";"))
    assert "separator" in fails(capsys, "data=tidy", f"data.path={tidy}")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["data=tidy"], "data.path"),
        (["model=krause"], "krauss"),
        (["model=krauss", "model.variannt=paper"], "variant"),
        (["learner.epoch=3"], "epochs"),
        (["+model.parameters.kapa.low=1"], "kapa"),
        (["model.parameters.T.default=99"], "outside its bounds"),
        (["model.parameters.T.low=20"], "T"),
        (["split=1.5"], "split"),
        (["windows.length=2"], "windows"),
        (["policy.inputs=[leader_sped]"], "leader_speed"),
        (["learner.epochs=fast"], "learner.epochs"),
        (["data.max_pairs=50"], "50"),
        (["data.pairs=6", "data.frames=9"], "min_duration"),
        (["data.min_duration=500"], "500 s"),
        (["style.cluster=agressive"], "aggressive"),
        (["device=cuda:99"], "device"),
    ],
)  # fmt: skip
def test_a_wrong_setting_is_told(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert expected in fails(capsys, *arguments)


def test_an_output_folder_that_cannot_be_made_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert "file" in fails(capsys, f"hydra.run.dir={tmp_path}/file/out")


def test_a_foreign_database_is_told_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.db"
    with sqlite3.connect(path) as connection:
        connection.execute("create table recipes (name text)")
    connection.close()
    message = fails(capsys, "tracking.enabled=true", f"tracking.uri=sqlite:///{path}")
    assert "other.db" in message


def test_loading_what_is_no_job_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no finished job"):
        cfx.load(tmp_path)


# ---- one number


@pytest.mark.parametrize("protocol", ["within_driver", "across_drivers"])
def test_a_calibration_has_one_number_and_no_policy_that_repeats_another_method(
    protocol: str, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["data.pairs=4", f"protocol={protocol}"]
    if protocol == "across_drivers":
        few += ["protocol.folds=2", "protocol.histories=[]"]
    result = run("policy=fixed", *few)
    assert "policy" not in set(result.pairs["method"])
    assert not [name for name in result.metrics if name.endswith("/policy") or "improve" in name]
    own = f"RMSE of speed driver-specific {result.metrics['rmse_speed/driver_specific']:.3f} m/s"
    said = [capsys.readouterr().out, repr(result), repr(cfx.load(result.folder))]
    assert all(own in one for one in said)


def test_a_job_that_is_interrupted_after_training_trains_nothing_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What comes after training may take longer than it, and the networks are written at the end."""
    workspace = Path("outputs", "cache", "training")
    small = ["learner=rollout", "learner.epochs=1", "protocol=across_drivers", "protocol.folds=2"]

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(steps, "calibration_tables", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(*small, "hydra.run.dir=first")
    (checkpoint,) = workspace.iterdir()
    again = run(*small, "hydra.run.dir=again")
    log = (again.folder / "cfx.log").read_text()
    assert f"Training goes on from {checkpoint.absolute()}" in log
    assert not list(workspace.iterdir())
