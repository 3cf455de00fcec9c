"""Jobs that MLflow keeps, in a report."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.errors import DataError, TrackingError
from cfx.results.mlflow.tracker import MlflowTracker
from cfx_report.runs import read_runs
from tests.job_folders import write_job


def broken_off(uri: str) -> None:
    with MlflowTracker.run(uri, run_name="broken", parameters={}, sweep="my sweep"):
        raise KeyboardInterrupt


def test_a_run_is_read_by_its_id_and_a_sweep_by_its_parents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri := f"sqlite:///{tmp_path}/mlflow.db")
    ids = {}
    for model in ("krauss", "w99"):
        folder = tmp_path / model
        metrics = write_job(folder, model=model, pairs=3, overrides=[f"model={model}"])
        tags = {"cfx.folder": str(folder)}
        with MlflowTracker.run(
            uri, run_name=model, parameters={"model.name": model}, tags=tags, sweep="my sweep"
        ) as tracker:
            tracker.log_files([path for path in folder.iterdir() if path.is_file()])
            store, ids[model] = tracker.store, tracker.run_id
    with pytest.raises(KeyboardInterrupt):
        broken_off(uri)
    (broken,) = {
        run.info.run_id
        for run in store.client.search_runs([store.experiment_id], "attributes.status = 'KILLED'")
    } - {store.client.get_run(ids["w99"]).data.tags["mlflow.parentRunId"]}

    (job,) = read_runs([ids["w99"]]).jobs
    assert (job.name, job.place, dict(job.metrics)) == ("w99", f"MLflow run {ids['w99']}", metrics)
    assert job.overrides == ("model=w99",)  # from the folder on this machine
    assert job.version
    assert job.started is not None

    parent = store.client.get_run(ids["w99"]).data.tags["mlflow.parentRunId"]
    found = read_runs([parent])
    assert [one.name for one in found.jobs] == ["krauss", "w99"]
    assert [(one.place, one.reason) for one in found.unfinished] == [
        (f"MLflow run {broken}", "KeyboardInterrupt")
    ]

    with pytest.raises(DataError, match=f"run {broken} holds no finished job; .*KeyboardInterrupt"):
        read_runs([broken])
    with pytest.raises(TrackingError, match="not found"):
        read_runs(["0" * 32])
    with pytest.raises(TrackingError, match="neither a job's output folder nor the id"):
        read_runs(["no-such-folder"])
