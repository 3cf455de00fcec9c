"""Output folders: never two jobs in one, nothing left of killed writers, no traceback for odd ones."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest
import yaml

from cfx.app import cli
from cfx.core.files import atomic_write, remove_leftovers
from cfx.errors import CfxError
from cfx.evaluation.protocols.within_driver import WithinDriver
from tests.broken_plugins import QUICK


def job(folder: Path, *overrides: str) -> int:
    return cli.main([*QUICK, f"hydra.run.dir={folder}", *overrides])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An earlier job's folder, to be copied."""
    folder = tmp_path_factory.mktemp("earlier") / "job"
    assert job(folder, "seed=1") == 0
    return folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """A folder that holds an earlier job's results."""
    return shutil.copytree(finished, tmp_path / "job")


def test_a_job_that_fails_leaves_an_earlier_jobs_folder_as_it_was(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {name: (folder / name).read_bytes() for name in ("config.yaml", "metrics.json")}

    def fail(*_: object) -> None:
        raise CfxError("the protocol failed")

    with monkeypatch.context() as broken:
        broken.setattr(WithinDriver, "run", fail)
        assert job(folder, "seed=2") == 2
    for name, content in before.items():
        assert (folder / name).read_bytes() == content
    assert job(folder, "seed=2") == 0
    assert yaml.safe_load((folder / "config.yaml").read_text())["seed"] == 2
    assert (folder / "metrics.json").read_bytes() != before["metrics.json"]


def test_while_results_are_replaced_nothing_says_that_they_are_complete(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise CfxError("the disk is full")

    with monkeypatch.context() as broken:
        broken.setattr("cfx.results.result.tables_of", fail)
        assert job(folder, "seed=2") == 2
    assert not (folder / "metrics.json").exists()
    assert job(folder, "seed=2") == 0
    assert json.loads((folder / "metrics.json").read_text())


def test_what_killed_writers_left_goes(tmp_path: Path) -> None:
    figures = tmp_path / "figures"
    figures.mkdir()
    with atomic_write(figures / "drives.png") as own:
        own.write_text("")
        written = own.name
    me = f".{os.getpid()}@"
    elsewhere = f"@another-{'0' * 8}."
    assert written.startswith(me)
    dead = figures / written.replace(me, ".999999999@")
    old = figures / f".999999999{elsewhere}old.png"
    kept = {
        figures / written: "its process still runs",
        figures / f".999999999{elsewhere}new.png": "nobody here knows whether its process runs",
        figures / ".hidden.png": "nobody's temporary file",
        figures / "drives.png": "a file",
    }
    for path in (dead, old, *kept):
        path.write_text("")
    yesterday = time.time() - 90000
    os.utime(old, (yesterday, yesterday))
    remove_leftovers(tmp_path)
    assert not dead.exists()
    assert not old.exists()
    for path, why in kept.items():
        assert path.exists(), why


def test_writers_of_one_file_have_a_temporary_file_each(tmp_path: Path) -> None:
    target = tmp_path / "file.txt"
    with atomic_write(target) as one, atomic_write(target) as other:
        assert one != other
        assert one.suffix == other.suffix == ".txt"
        one.write_text("one")
        other.write_text("other")
    assert target.read_text() == "one", "the outer block ends last"
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_in_the_place_of_the_log_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "job" / "cfx.log").mkdir(parents=True)
    assert job(tmp_path / "job") == 2
    err = capsys.readouterr().err
    assert "cfx.log: Is a directory; choose an output folder" in err
    assert "Traceback" not in err


def test_an_odd_name_of_the_working_directory_is_taken_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "per%cent q?mark a=b,c"
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
