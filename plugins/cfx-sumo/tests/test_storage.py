"""Jobs behind a URL are exported as those of a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.app import cli
from cfx.results.folder import Upload
from tests.job_folders import write_job

pytest.importorskip("moto", reason="moto stands in for S3")


def test_a_job_at_a_url_is_exported_where_the_user_is(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_job(tmp_path / "mine", pairs=4)
    policy = tmp_path / "mine" / "policy" / "policy.json"
    policy.parent.mkdir()
    policy.write_text('{"dt": 0.1}', encoding="utf-8")
    Upload(f"{bucket}/jobs", tmp_path / "mine").finish()
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    assert cli.main(["export", f"{bucket}/jobs/mine", "--to", "sumo"]) == 0
    assert (here / "drivers.add.xml").is_file()
