"""Jobs behind a URL are reported as those of a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.app import cli
from cfx.results.folder import Upload
from cfx_report.runs import read_runs
from tests.broken_plugins import QUICK
from tests.job_folders import write_job

from .rendered import blank_drawings

pytest.importorskip("moto", reason="moto stands in for S3")

JOB = (*QUICK, "data.pairs=3")


def test_a_sweep_whose_jobs_were_copied_is_read_from_its_url(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = tmp_path / "sweep"
    arguments = ["-m", *JOB, "seed=0,1", f"hydra.sweep.dir={sweep}", f"output.url={bucket}"]
    assert cli.main(arguments) == 0
    runs = read_runs([f"{bucket}/sweep"])
    assert {found.place for found in runs.jobs} == {
        f"{bucket}/sweep/{folder.name}" for folder in sweep.iterdir() if folder.is_dir()
    }


def test_a_job_at_a_url_is_reported_where_the_user_is(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_job(tmp_path / "mine", pairs=4)
    Upload(f"{bucket}/jobs", tmp_path / "mine").finish()
    url = f"{bucket}/jobs/mine"
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    with blank_drawings():
        assert cli.main(["report", url]) == 0
    assert cli.main(["report", url, "--tables", "csv"]) == 0
    assert url in (here / "report.html").read_text(encoding="utf-8")
    assert (here / "report.csv").is_file()
