"""Which jobs a report finds, and what it says of those that it cannot read."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cfx.app.cli import main
from cfx.errors import DataError
from cfx_report.runs import read_runs
from tests.job_folders import ACROSS, write_job


def test_a_sweep_gives_its_finished_jobs_and_names_the_others(tmp_path: Path) -> None:
    for number in (10, 2):
        write_job(tmp_path / f"{number}-krauss", settings={"seed": number})
    failed, running = tmp_path / "3-krauss", tmp_path / "4-krauss"
    failed.mkdir()
    (failed / "outcome.json").write_text(
        json.dumps({"code": 2, "message": "seed: must be positive"}), encoding="utf-8"
    )
    (running / ".hydra").mkdir(parents=True)
    found = read_runs([str(tmp_path)])
    assert [job.name for job in found.jobs] == ["krauss · seed 2", "krauss · seed 10"]
    assert {Path(one.place).name: one.reason for one in found.unfinished} == {
        "3-krauss": "failed: seed: must be positive",
        "4-krauss": "not finished: it has no metrics.json",
    }


def test_a_job_is_read_once_however_often_it_is_named(tmp_path: Path) -> None:
    write_job(tmp_path / "sweep" / "0")
    write_job(tmp_path / "sweep" / "1", model="w99")
    found = read_runs([str(tmp_path / "sweep" / "1"), str(tmp_path / "sweep")])
    assert [job.name for job in found.jobs] == ["w99", "krauss"]


def test_settings_outside_of_groups_keep_their_names(tmp_path: Path) -> None:
    """And which experiment chose the settings tells no jobs apart."""
    write_job(tmp_path / "0", settings={"split": 0.8, "preset": "adaptive"})
    write_job(tmp_path / "1", settings={"split": 0.7, "preset": None})
    names = [job.name for job in read_runs([str(tmp_path / "0"), str(tmp_path / "1")]).jobs]
    assert names == ["krauss · split=0.8", "krauss · split=0.7"]


def test_jobs_are_named_by_what_differs(tmp_path: Path) -> None:
    write_job(
        tmp_path / "a", model="krauss", settings={"learner": {"name": "imitation", "epochs": 20}}
    )
    write_job(
        tmp_path / "b", model="krauss", settings={"learner": {"name": "imitation", "epochs": 500}}
    )
    write_job(
        tmp_path / "c", model="theirs", settings={"learner": {"name": "imitation", "epochs": 500}}
    )
    write_job(
        tmp_path / "d",
        model="theirs",
        settings={"learner": {"name": "imitation", "epochs": 500}, "threads": 3},
    )
    names = [job.name for job in read_runs([str(tmp_path)]).jobs]
    assert names == [
        "krauss · epochs=20",
        "krauss · epochs=500",
        "theirs · epochs=500 (1)",
        "theirs · epochs=500 (2)",
    ]


def test_many_differences_are_shortened_where_jobs_are_alike(tmp_path: Path) -> None:
    """What tells jobs apart stays in their names; what differs along with it is left out."""
    for number, (split, epochs) in enumerate(((0.8, 10), (0.8, 20), (0.7, 10))):
        path = f"/home/ann/recordings/of/2025/{'long' if split == 0.8 else 'short'}.parquet"
        write_job(
            tmp_path / str(number),
            settings={
                "data": {"name": "tidy", "path": path},
                "split": split,
                "learner": {"name": "imitation", "epochs": epochs, "steps": 2 * epochs},
                "policy": {"name": "gru", "hidden_size": epochs},
            },
        )
    names = [job.name for job in read_runs([str(tmp_path)]).jobs]
    assert names == [
        "krauss · path=…long.parquet · hidden_size=10",
        "krauss · path=…long.parquet · hidden_size=20",
        "krauss · path=…short.parquet · hidden_size=10",
    ]


def test_what_a_job_says_of_itself(tmp_path: Path) -> None:
    metrics = write_job(
        tmp_path / "job", methods=ACROSS, experiment="paper/clusters", overrides=["model=krauss"]
    )
    (job,) = read_runs([str(tmp_path / "job")]).jobs
    assert job.methods == ACROSS
    assert job.baselines() == ("driver_specific", "default", "pooled")
    assert job.baselines("full_trajectory") == ("default", "pooled")
    assert (job.setting("preset") or "", job.overrides, job.seconds) == (
        "paper/clusters",
        ("model=krauss",),
        65.0,
    )
    assert dict(job.metrics) == metrics
    assert job.setting("tracking.uri") == "postgresql://someone:***@host/db"


def test_a_job_that_lacks_files_is_still_read(tmp_path: Path) -> None:
    write_job(tmp_path / "job")
    for name in ("trajectories.parquet", "curves.parquet", "style.csv", "data.json", "cfx.log"):
        (tmp_path / "job" / name).unlink()
    shutil.rmtree(tmp_path / "job" / ".hydra")
    (job,) = read_runs([str(tmp_path / "job")]).jobs
    assert set(job.missing) == {"trajectories.parquet", "curves.parquet", "style.csv"}
    assert (job.setting("preset") or "", job.overrides, job.started) == ("", None, None)


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("metrics.json", "{", "cannot be read"),
        ("metrics.json", "[1]", "holds no mapping"),
        ("metrics.json", '{"rmse_speed/policy": "fast"}', "a metric is no number"),
        ("config.yaml", "a: [", "cannot be read"),
        ("pairs.csv", "pair_id,driver\n1,2\n", "no column 'cluster'"),
        ("pairs.csv", "", "cannot be read"),
        ("trajectories.parquet", "no parquet", "cannot be read"),
        ("curves.parquet", "", "cannot be read"),
        ("style.csv", "driver,score,cluster\nd,high,0\n", "column 'score'"),
        ("data.json", "\x00", "cannot be read"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, file: str, content: str, said: str) -> None:
    write_job(tmp_path / "job", pairs=3)
    (tmp_path / "job" / file).write_text(content, encoding="utf-8")
    with pytest.raises(DataError, match=said) as caught:
        read_runs([str(tmp_path)])
    assert str(tmp_path / "job" / file) in str(caught.value)


@pytest.mark.usefixtures("blank_figures")
def test_the_command_says_in_one_sentence_what_it_cannot_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "empty").mkdir()
    (tmp_path / "a-file").touch()
    write_job(tmp_path / "job", pairs=3)
    for arguments, said in (
        (["empty"], "empty holds no finished job"),
        (["a-file"], "a-file is a file"),
        (["0" * 32], "there is no MLflow database"),
        (["job", "--output", "a-file/report.html"], "the report cannot be written"),
        (["job", "--output", "empty"], "the report cannot be written"),
    ):
        assert main(["report", *arguments]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "a-file", "job"}
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_beside_the_jobs_and_says_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_job(tmp_path / "sweep" / "0", pairs=3)
    assert main(["report", str(tmp_path / "sweep"), "--title", "My title"]) == 0
    assert capsys.readouterr().out == f"Report of 1 job: {tmp_path / 'sweep' / 'report.html'}\n"
    assert "<title>My title</title>" in (tmp_path / "sweep" / "report.html").read_text(
        encoding="utf-8"
    )
