"""A run in a real SQLite store holds what the contract says, and never stays RUNNING."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from cfx.core import registry
from cfx.data.tidy import write_tidy
from cfx.errors import TrackingError
from cfx.evaluation.headline import headline
from cfx.evaluation.result import Purpose
from cfx.models.krauss import Krauss
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler, token_width
from cfx.policies.gru import GruPolicy
from cfx.policies.heads.base import DirectHead
from cfx.policies.prediction import predict_frame
from cfx.results import provenance
from cfx.results.config import JobConfig
from cfx.results.mlflow.store import download_run, quiet, translate_errors
from cfx.results.mlflow.tracker import CURVE_POINTS, MlflowTracker, sweep_link
from cfx.results.result import Result
from cfx.results.tracker import tracked
from cfx.simulation.windows import WindowSettings
from tests.drives import wavy_pairs
from tests.forks import Forks
from tests.made_up import MadeUp, make_curves, make_results

NODE = {
    "data": "synthetic",
    "model": "krauss",
    "policy": "gru",
    "optimizer": "random",
    "learner": "imitation",
    "protocol": "within_driver",
}


@pytest.fixture(autouse=True)
def _own_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test has a folder of its own to start jobs in, and no tracking URI from outside."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty MLflow database; making one takes a second."""
    folder = tmp_path_factory.mktemp("template")
    with MlflowTracker.run(
        f"sqlite:///{folder}/mlflow.db", experiment="other", run_name="x", parameters={}
    ):
        pass
    return folder / "mlflow.db"


@pytest.fixture
def uri(tmp_path: Path, template: Path) -> str:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "mlflow.db").write_bytes(template.read_bytes())
    return f"sqlite:///{tmp_path}/store/mlflow.db"


@pytest.fixture
def client(uri: str) -> Iterator[Any]:
    with quiet():
        from mlflow import MlflowClient

        yield MlflowClient(uri)


def begin(uri: str, **changes: Any) -> Any:
    options: dict[str, Any] = {
        "run_name": "krauss-gru",
        "parameters": {"seed": "0"},
        "tags": {"model": "krauss"},
    }
    return MlflowTracker.run(uri, **(options | changes))


def log_job(
    run: MlflowTracker,
    made: MadeUp,
    saved: SimpleNamespace,
    *files: Path,
    figures: Sequence[Path] = (),
) -> None:
    """Logs made-up results, with a policy that is not theirs."""
    folder = saved.folder.parent
    made.evaluation.table.to_csv(folder / "pairs.csv")
    for name in ("config.yaml", "metrics.json", "data.json"):
        (folder / name).touch()
    evaluation = replace(made.evaluation, tables={"curves": made.curves}, recorded=saved.pairs)
    result = replace(
        Result.of(evaluation),
        tables={"pairs": made.evaluation.table},
        folder=folder,
        figures=tuple(figures),
        demo=files,
    )
    run.log_job(result, "**What** it is.")


def table_of(client: Any, run_id: str) -> pd.DataFrame:
    """Reads the logged table as MLflow's `load_table` does, but from this client's store."""
    return pd.read_json(client.download_artifacts(run_id, "pairs.json"), orient="split")


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def config_of(uri: str | None, **tracking: Any) -> JobConfig:
    nodes = {kind: {"name": name} for kind, name in NODE.items()}
    return JobConfig.of({**nodes, "tracking": {"uri": uri, **tracking}})


def test_a_job_is_kept_under_the_names_of_the_contract(
    uri: str, client: Any, tmp_path: Path, saved_policy: SimpleNamespace
) -> None:
    results = make_results(pairs=4, frames=20)
    (tmp_path / "drives.png").write_bytes(b"png")
    with tracked(config_of(uri), tmp_path / "job") as run:
        assert client.get_run(run.run_id).info.status == "RUNNING"
        run.set_tags({"dataset.fingerprint": "f" * 64})
        log_job(
            run,
            results,
            saved_policy,
            figures=[tmp_path / "drives.png"],
        )
    kept = client.get_run(run.run_id)
    assert kept.info.status == "FINISHED"
    assert kept.info.run_name == "krauss-gru-random-synthetic"
    losses = {"train_loss", "validation_loss"}
    metrics = {name: value for name, value in kept.data.metrics.items() if name not in losses}
    first, words = headline(results.evaluation.metrics())
    assert metrics == pytest.approx(first), "all other metrics are in metrics.json"
    assert len(kept.data.metrics) <= 12
    assert kept.data.tags["result"] == words
    assert losses <= set(kept.data.metrics)
    assert kept.data.params == {**NODE, "objective": "speed_rmse", "seed": "0"}
    tags = kept.data.tags
    assert {kind: tags[kind] for kind in NODE} == NODE
    assert tags["cfx.version"] == provenance.version()
    assert tags["cfx.plugins"] == "none"
    assert tags["dataset.fingerprint"] == "f" * 64
    assert "cfx.sweep" not in tags
    assert {file.path for file in client.list_artifacts(run.run_id)} == {
        "figures",
        "metrics.json",
        "config.yaml",
        "data.json",
        "pairs.csv",
        "pairs.json",
        "policy",
    }
    table = table_of(client, run.run_id)
    assert len(table) == 12
    assert table["rmse_speed"].to_numpy() == pytest.approx(
        results.evaluation.table["rmse_speed"].to_numpy()
    )
    assert tags["mlflow.note.content"] == "**What** it is."
    (one,) = kept.inputs.dataset_inputs
    assert one.dataset.digest == saved_policy.pairs.fingerprint[:8]
    assert json.loads(one.dataset.profile)["pairs"] == 2


def test_undefined_metrics_are_kept_as_such(uri: str, client: Any) -> None:
    with begin(uri) as run:
        run.log_metrics({"improvement/rmse_speed/driver_specific/p_value": float("nan")})
    assert np.isnan(
        client.get_run(run.run_id).data.metrics["improvement/rmse_speed/driver_specific/p_value"]
    )


def test_a_store_is_made_beside_the_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tracked(config_of(None), tmp_path / "job") as run:
        run.set_tags({"x": "y"})
    assert (tmp_path / "outputs" / "mlflow.db").is_file()
    assert (tmp_path / "outputs" / "mlartifacts" / run.run_id).is_dir()
    assert names_in(tmp_path) == ["outputs"]
    assert names_in(tmp_path / "outputs") == ["mlartifacts", "mlflow.db", "mlflow.db.lock"]
    (line,) = run.how_to_open()
    assert line.startswith("To see it in MLflow: python -m cfx ui, then http://127.0.0.1:5000/#/")
    assert f"runs/{run.run_id}?" in line
    monkeypatch.setenv("MLFLOW_TRACKING_URI", run.store.uri)  # as programs do, which a shell
    (line,) = run.how_to_open()  # does not know of
    assert f"python -m cfx ui --uri {run.store.uri}, then" in line


def test_tracking_can_be_off(tmp_path: Path, saved_policy: SimpleNamespace) -> None:
    before = names_in(tmp_path)
    with tracked(config_of("nonsense", enabled=False), tmp_path) as run:
        run.set_tags({"a": "b"})
        log_job(run, make_results(pairs=1, frames=10), saved_policy)
    assert (run.run_id, run.how_to_open()) == ("", ())
    assert names_in(tmp_path) == sorted(
        [*before, "config.yaml", "data.json", "metrics.json", "pairs.csv"]
    )


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (ValueError("no such\nlane"), "FAILED", "ValueError: no such lane"),
        (KeyboardInterrupt(), "KILLED", "KeyboardInterrupt"),
        (SystemExit(143), "KILLED", "SystemExit: 143"),
    ],
)
def test_a_broken_job_says_how_it_ended(
    uri: str, client: Any, error: BaseException, status: str, reason: str
) -> None:
    with pytest.raises(type(error)), begin(uri) as run:
        raise error
    kept = client.get_run(run.run_id)
    assert (kept.info.status, kept.data.tags["cfx.failure"]) == (status, reason)
    assert kept.info.end_time is not None


def test_the_jobs_own_error_is_the_one_the_user_sees(
    uri: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise OSError("disk full")

    def job() -> None:
        with begin(uri) as run:
            monkeypatch.setattr(run.store.client, "set_terminated", broken)
            raise ValueError("first")

    with caplog.at_level(logging.WARNING), pytest.raises(ValueError, match="first"):
        job()
    assert "MLflow could not close the run: disk full" in caplog.text


def test_a_job_that_starts_again_goes_on_in_its_run(uri: str, client: Any, tmp_path: Path) -> None:
    table = make_results(pairs=1, frames=10).evaluation.table
    same = {"tags": {"cfx.folder": str(tmp_path)}}
    started = []

    def broken_job() -> None:
        with begin(uri, **same) as run:
            started.append(run)
            run.log_table(table, "pairs.json")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        broken_job()
    first = started[0]
    with begin(uri, **same) as second:
        second.log_table(table, "pairs.json")
    assert second.run_id == first.run_id
    kept = client.get_run(first.run_id)
    assert kept.info.status == "FINISHED"
    assert "cfx.failure" not in kept.data.tags
    assert len(table_of(client, first.run_id)) == 3
    with begin(uri, **same) as third:
        pass
    with begin(uri, **same, parameters={"seed": "1"}) as fourth:
        pass
    assert len({first.run_id, third.run_id, fourth.run_id}) == 3


@pytest.mark.parametrize("loss", [0.5, 0.25])
def test_a_job_of_a_sweep_that_is_done_twice_is_there_once(
    loss: float, uri: str, client: Any, tmp_path: Path
) -> None:
    """A job may be killed after its run was closed, and before its folder says so."""
    same = {"tags": {"cfx.folder": str(tmp_path)}, "sweep": "s"}
    with begin(uri, **same) as first:
        first.log_metrics({"loss": 0.5, "undefined": float("nan")})
    with begin(uri, **same) as second:
        second.log_metrics({"loss": loss, "undefined": float("nan")})
    assert second.run_id != first.run_id
    kept = client.get_run(first.run_id)
    assert kept.data.tags["cfx.replaced_by"] == second.run_id
    # Other numbers are kept beside the new ones.
    assert (kept.info.lifecycle_stage == "deleted") == (loss == 0.5)


def test_a_run_whose_process_is_gone_is_closed(uri: str, client: Any) -> None:
    with begin(uri, sweep="s") as gone, begin(uri, parameters={"seed": "1"}) as alive:
        dead = subprocess.run(
            [sys.executable, "-c", "import os; print(os.getpid())"],
            capture_output=True,
            text=True,
            check=True,
        )
        client.set_tag(gone.run_id, "cfx.process", f"{dead.stdout.strip()}@1000000000")
        with begin(uri, parameters={"seed": "2"}):
            assert client.get_run(alive.run_id).info.status == "RUNNING"
            kept = client.get_run(gone.run_id)
            assert (kept.info.status, kept.data.tags["cfx.failure"]) == (
                "KILLED",
                "the process ended without closing the run",
            )
            assert client.get_run(kept.data.tags["mlflow.parentRunId"]).info.status == "KILLED"


JOB = """
import sys, warnings
warnings.simplefilter("error")
from cfx.results.mlflow.tracker import MlflowTracker
uri, seed = sys.argv[1:]
sweep = "a sweep'of/many"
with MlflowTracker.run(uri, run_name=f"job {seed}", parameters={"seed": seed}, sweep=sweep) as run:
    run.set_tags({"seed": seed})
"""


def test_two_processes_begin_a_sweep_at_once(tmp_path: Path) -> None:
    """They make the database, the experiment and one parent between them."""
    uri = f"sqlite:///{tmp_path}/new/deeper/mlflow.db"
    (tmp_path / "forks").mkdir()
    # Connections are made by each process: the one they come from only imports.
    with Forks("import mlflow, cfx.results.mlflow.tracker", tmp_path / "forks") as forks:
        jobs = [forks.start(["-c", JOB, uri, str(k)], tmp_path) for k in range(2)]
        codes = [job.wait() for job in jobs]
    said = [job.out.read_text() + job.error.read_text() for job in jobs]
    assert codes == [0] * 2, said
    assert said == [""] * 2
    with quiet():
        from mlflow import MlflowClient

        client = MlflowClient(uri)
        runs = client.search_runs([client.get_experiment_by_name("cfx").experiment_id])
    parents = [run for run in runs if "cfx.sweep_parent" in run.data.tags]
    children = [run for run in runs if run.data.tags.get("cfx.sweep") == "a_sweep_of/many"]
    assert (len(parents), len(children), len(runs)) == (1, 2, 3)
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert {run.data.tags["mlflow.parentRunId"] for run in children} == {parents[0].info.run_id}
    assert {run.data.params["seed"] for run in children} == set("01")


def test_a_sweep_has_the_status_of_its_jobs(uri: str, client: Any) -> None:
    def parent() -> str:
        (run,) = client.search_runs([one.store.experiment_id], "tags.`cfx.sweep_parent` = 's'")
        return str(run.info.status)

    with begin(uri, sweep="s") as one:
        assert parent() == "RUNNING"
        with (
            pytest.raises(RuntimeError),
            begin(uri, sweep="s", parameters={"seed": "1"}, tags={"cfx.folder": "b"}),
        ):
            raise RuntimeError
        assert parent() == "RUNNING"
    assert parent() == "FAILED"
    with begin(uri, sweep="s", parameters={"seed": "1"}, tags={"cfx.folder": "b"}):
        assert parent() == "RUNNING"
    assert parent() == "FINISHED"
    assert sweep_link("1", "s").startswith(
        "#/experiments/1/runs?searchFilter=tags.%60cfx.sweep%60%20%3D%20%27s%27&orderByKey=metrics."
    )
    assert one.how_to_open() == ()  # the sweep's own link comes once, at its end


def test_long_values_and_odd_keys_are_kept(uri: str, client: Any) -> None:
    odd = {
        "data.path": "x" * 9000,
        "model.parameters.k(ü)[0]": "1",
        "empty": "",
        "unicode": "50 ‰",
    } | {f"p{k}": "v" for k in range(250)}
    with begin(uri, parameters=odd, tags={"note": "y" * 9000, "empty": ""}) as run:
        pass
    kept = client.get_run(run.run_id).data
    assert kept.params["data.path"] == "x" * 5999 + "…"
    assert (
        kept.params[
            "model.parameters.k(ü)[0]".replace("(", "_")
            .replace(")", "_")
            .replace("[", "_")
            .replace("]", "_")
        ]
        == "1"
    )
    assert (kept.params["empty"], kept.params["unicode"]) == ("", "50 ‰")
    assert len(kept.params) == len(odd)
    assert kept.tags["note"].endswith("y…")


def test_learning_curves_are_means_and_bounded(uri: str, client: Any) -> None:
    curves = make_curves(networks=3, epochs=500)
    with begin(uri) as run:
        run.log_curves(curves)
        run.log_curves(make_curves(networks=0, epochs=0))
    points = client.get_metric_history(run.run_id, "train_loss")
    assert len(points) == CURVE_POINTS
    steps = [point.step for point in points]
    assert (min(steps), max(steps)) == (0, 499)
    start = curves[curves["epoch"] == 0]["train_loss"].mean()
    assert next(point.value for point in points if point.step == 0) == pytest.approx(start)
    assert len(client.get_metric_history(run.run_id, "validation_loss")) == CURVE_POINTS


@pytest.fixture
def saved_policy(tmp_path: Path) -> SimpleNamespace:
    """A small network as a job saves it, and a table to drive on."""
    model, policy, windows = Krauss(), GruPolicy(hidden_size=8), WindowSettings()
    width = token_width(policy.inputs, policy.summary, windows.length)
    blank = torch.zeros((1, 2))
    network = policy.build(width, blank[0], blank, torch.Generator().manual_seed(3)).eval()
    scaler = Scaler(torch.zeros((1, width)), torch.ones((1, width)))
    trained = Agent(
        core=AgentCore(policy, network, scaler, DirectHead(model.space)),
        model_node={"name": "krauss"},
        policy_node={"name": "gru", "hidden_size": 8},
        windows=windows,
        dt=0.1,
        names=("all",),
    )
    checkpoint.save_agent(trained, tmp_path / "policy")
    pairs = wavy_pairs(model, torch.tensor([[1.5, 0.1], [2.0, 0.3]]).double(), frames=60)
    write_tidy(pairs, tmp_path / "pairs.parquet")
    return SimpleNamespace(
        policy=trained,
        folder=tmp_path / "policy",
        frame=pd.read_parquet(tmp_path / "pairs.parquet"),
        pairs=pairs,
    )


def test_a_logged_policy_loads_again_and_predicts_the_same(
    uri: str, client: Any, saved_policy: SimpleNamespace, tmp_path: Path
) -> None:
    with begin(uri) as run:
        run.log_policy(saved_policy.folder, saved_policy.pairs)
    (output,) = client.get_run(run.run_id).outputs.model_outputs
    assert run.model_uri == f"models:/{output.model_id}"
    expected = predict_frame(saved_policy.policy, saved_policy.frame)
    with quiet():
        import mlflow

        before = mlflow.get_tracking_uri()
        mlflow.set_tracking_uri(uri)
        try:
            loaded = mlflow.pyfunc.load_model(run.model_uri)
        finally:
            mlflow.set_tracking_uri(before)
            os.environ.pop("MLFLOW_TRACKING_URI", None)  # MLflow sets it too
        pd.testing.assert_frame_equal(loaded.predict(saved_policy.frame), expected)
        # Ids and lengths as whole numbers, as a user's CSV has them.
        plain = saved_policy.frame.assign(leader_id=1, leader_length_m=5)
        assert list(loaded.predict(plain).columns) == list(expected.columns)
        assert "leader_speed_mps" in loaded.metadata.get_input_schema().input_names()
        assert loaded.metadata.get_output_schema().input_names() == list(expected.columns)
        assert len(loaded.input_example) == 50
    files = {path.name for path in (tmp_path / "store").rglob("*") if path.is_file()}
    assert {"served_policy.py", "policy.safetensors", "policy.json", "requirements.txt"} <= files
    assert not any(name.endswith(".pkl") for name in files)
    (requirements,) = (tmp_path / "store").rglob("requirements.txt")
    assert f"cfx-driving=={provenance.version()}" in requirements.read_text().split()


def test_a_job_comes_back_from_its_run(
    uri: str, saved_policy: SimpleNamespace, tmp_path: Path
) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    with begin(uri) as run:
        run.log_policy(saved_policy.folder)
        run.log_files([tmp_path / "metrics.json"])
    folder = download_run(run.run_id, uri)
    assert (folder / "metrics.json").read_text() == "{}"
    expected = predict_frame(saved_policy.policy, saved_policy.frame)
    pd.testing.assert_frame_equal(
        predict_frame(checkpoint.load_agent(folder / "policy"), saved_policy.frame), expected
    )
    for wrong, message in (
        ("nothing", "neither a job's output folder nor the id"),
        ("0" * 32, "could not read run 000"),
    ):
        with pytest.raises(TrackingError, match=message):
            download_run(wrong, uri)


def test_nothing_is_printed_and_nothing_global_changes(
    tmp_path: Path, saved_policy: SimpleNamespace, capfd: pytest.CaptureFixture[str]
) -> None:
    """From a database that is made to a policy that is copied, MLflow prints nothing."""
    with quiet():
        import mlflow
    root, ours, before = logging.getLogger(), logging.getLogger("mlflow"), mlflow.get_tracking_uri()
    state = (root.handlers[:], root.level, ours.level, dict(os.environ))
    results = make_results(pairs=2, frames=10)
    with begin(f"sqlite:///{tmp_path}/fresh.db") as run:
        log_job(run, results, saved_policy)
    assert tuple(capfd.readouterr()) == ("", "")
    assert (root.handlers[:], root.level, ours.level, dict(os.environ)) == state
    assert mlflow.get_tracking_uri() == before
    assert mlflow.active_run() is None


def test_what_mlflow_refuses_is_one_sentence(uri: str) -> None:
    with (
        pytest.raises(TrackingError, match=r"^MLflow could not log .*missing\.png: .*$") as caught,
        begin(uri) as run,
    ):
        run.log_files([Path("missing.png")])
    assert "\n" not in str(caught.value)
    with pytest.raises(TrackingError, match="holds no policy"), begin(uri) as run:
        run.log_policy(Path("missing"))
    with (
        pytest.raises(TrackingError, match="could not dance: Permission denied"),
        translate_errors("dance"),
    ):
        raise PermissionError("Permission denied")


def test_artifacts_that_cannot_be_written_are_found_at_the_start(
    uri: str, client: Any, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("in the way")
    client.create_experiment("cfx", artifact_location=(tmp_path / "file" / "artifacts").as_uri())
    with (
        pytest.raises(TrackingError, match=r"could not begin the run: .*Not a directory"),
        begin(uri),
    ):
        pytest.fail("the job must not start")
    (run,) = client.search_runs([client.get_experiment_by_name("cfx").experiment_id])
    assert run.info.status == "FAILED"


def test_plugins_are_named_with_their_versions(
    uri: str, client: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    real = registry.entry

    def entry(kind: str, name: str) -> Any:
        if kind == "tracker":
            return real(kind, name)
        plugin = kind == "model"
        return SimpleNamespace(
            distribution="cfx-community" if plugin else "cfx-driving",
            version="0.3" if plugin else "0.1",
        )

    monkeypatch.setattr(registry, "entry", entry)
    with tracked(config_of(uri), tmp_path) as run:
        pass
    tags = client.get_run(run.run_id).data.tags
    assert (tags["cfx.plugins"], tags["cfx.plugin.cfx-community"]) == ("cfx-community 0.3", "0.3")
    assert provenance.distributions({"model": {"name": "krauss"}}) == {"cfx-community": "0.3"}


def test_the_commit_of_the_users_checkout(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        who = {
            "GIT_AUTHOR_NAME": "a",
            "GIT_AUTHOR_EMAIL": "a@b",
            "GIT_COMMITTER_NAME": "a",
            "GIT_COMMITTER_EMAIL": "a@b",
        }
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *arguments],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | who,
        )
        return done.stdout.strip()

    assert provenance.git_state(tmp_path) == {}
    git("init", "-q")
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-qm", "one")
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "new").write_text("untracked")
    commit = git("rev-parse", "HEAD")
    assert provenance.git_state(tmp_path) == {
        "cfx.git_commit": commit,
        "cfx.git_dirty": "false",
        "mlflow.source.git.commit": commit,
    }
    (tmp_path / "file").write_text("2")
    assert provenance.git_state(tmp_path)["cfx.git_dirty"] == "true"


def test_flatten() -> None:
    nested = {"a": {"b": 1, "c": {}}, "d": [1, 2], "e": [{"f": None}], "g": True, "h": 0.5}
    assert provenance.flatten(nested) == {
        "a.b": "1", "a.c": "{}", "d": "[1, 2]", "e.0.f": "null", "g": "true", "h": "0.5",
    }  # fmt: skip


def test_a_calibration_logs_no_improvement(
    uri: str, client: Any, saved_policy: SimpleNamespace
) -> None:
    made = make_results(pairs=2, frames=10, methods=("default", "pooled", "driver_specific"))
    evaluation = dataclasses.replace(made.evaluation, purpose=Purpose.CALIBRATION)
    with begin(uri) as run:
        log_job(run, dataclasses.replace(made, evaluation=evaluation), saved_policy)
    kept = client.get_run(run.run_id).data
    assert not [name for name in kept.metrics if "improvement" in name]
    assert kept.tags["result"].startswith("RMSE of speed driver-specific")
    assert kept.tags["learner"] == "none"
