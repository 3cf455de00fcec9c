"""Output folders: never two jobs in one, nothing left of killed writers, no traceback for odd ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from cfx import cli
from cfx.errors import CfxError
from cfx.files import remove_leftovers
from cfx.job import steps
from tests.broken_plugins import QUICK


def job(folder: Path, *overrides: str) -> int:
    return cli.main([*QUICK, f"hydra.run.dir={folder}", *overrides])


def test_a_job_that_fails_leaves_an_earlier_jobs_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "job"
    assert job(folder, "seed=1") == 0
    before = {name: (folder / name).read_bytes() for name in ("config.yaml", "metrics.json")}

    def fail(*_: object) -> None:
        raise CfxError("the protocol failed")

    with monkeypatch.context() as broken:
        broken.setattr(steps, "_run_protocol", fail)
        assert job(folder, "seed=2") == 2
    for name, content in before.items():
        assert (folder / name).read_bytes() == content
    assert job(folder, "seed=2") == 0
    assert yaml.safe_load((folder / "config.yaml").read_text())["seed"] == 2
    assert (folder / "metrics.json").read_bytes() != before["metrics.json"]


def test_while_results_are_replaced_nothing_says_that_they_are_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "job"
    assert job(folder) == 0

    def fail(*_: object, **__: object) -> None:
        raise CfxError("the disk is full")

    with monkeypatch.context() as broken:
        broken.setattr(steps.files, "write_tables", fail)
        assert job(folder, "seed=2") == 2
    assert not (folder / "metrics.json").exists()
    assert job(folder, "seed=2") == 0
    assert json.loads((folder / "metrics.json").read_text())


def test_what_killed_writers_left_goes(tmp_path: Path) -> None:
    figures = tmp_path / "figures"
    figures.mkdir()
    dead, kept = figures / ".999999999.drives.png", figures / ".1.drives.png"
    for path in (dead, kept, figures / ".hidden.png", figures / "drives.png"):
        path.write_text("")
    remove_leftovers(tmp_path)
    assert not dead.exists()
    assert kept.exists(), "process 1 still runs"
    assert (figures / ".hidden.png").exists()
    assert (figures / "drives.png").exists()


def test_a_folder_in_the_place_of_the_log_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "job" / "cfx.log").mkdir(parents=True)
    assert job(tmp_path / "job") == 2
    err = capsys.readouterr().err
    assert "cfx.log: Is a directory; choose an output folder" in err
    assert "Traceback" not in err


@pytest.mark.parametrize("name", ["per%cent", "q?mark", "a=b,c", "white space"])
def test_odd_names_of_working_directories_are_taken_as_they_are(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / name
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert cli.main([*QUICK]) == 0
    assert len(list(folder.glob("outputs/*/*/metrics.json"))) == 1
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_working_directory_that_hydra_would_rewrite_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "${oc.env:HOME}"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert cli.main([*QUICK]) == 2
    assert "holds '${', which Hydra replaces" in capsys.readouterr().err
    assert not list(folder.iterdir())
