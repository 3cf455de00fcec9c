"""A store that cannot be used is found at once; one sentence names the file and the remedy."""

from __future__ import annotations

import re
import socket
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from cfx.errors import TrackingError
from cfx.results.mlflow import store
from cfx.results.mlflow.store import open_store, tracking_uri


@pytest.fixture(autouse=True)
def _own_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    # Long enough to be waited for, short enough for a test.
    monkeypatch.setattr(store, "LOCK_SECONDS", 0.2)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("template") / "mlflow.db"
    open_store(f"sqlite:///{file}", "cfx")
    return file.read_bytes()


@pytest.fixture
def database(tmp_path: Path, template: bytes) -> Path:
    file = tmp_path / "mlflow.db"
    file.write_bytes(template)
    return file


def refused(file: Path | str, message: str) -> None:
    """Opening raises one sentence with file, reason and what to do; the file stays as it was."""
    path = Path(file)
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(TrackingError, match=message) as caught:
        open_store(f"sqlite:///{file}", "cfx")
    assert "\n" not in str(caught.value)
    assert "tracking.uri=sqlite:///FILE" in str(caught.value)
    assert str(file) in str(caught.value)
    assert (path.read_bytes() if path.is_file() else None) == before


def test_a_database_held_by_another_process(database: Path) -> None:
    with closing(sqlite3.connect(database, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        refused(database, "the MLflow database is locked by another process; close what holds it")
        other.execute("ROLLBACK")
    assert open_store(f"sqlite:///{database}", "cfx").experiment_id


def test_a_database_of_another_program(tmp_path: Path) -> None:
    file = tmp_path / "photos.db"
    with closing(sqlite3.connect(file)) as other:
        other.execute("CREATE TABLE photos (name TEXT)")
    refused(file, "is an SQLite database, but not MLflow's")


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    (tmp_path / "notes.db").write_text("dear diary " * 200)
    refused(tmp_path / "notes.db", "is not an SQLite database")


def test_a_database_of_another_mlflow(database: Path) -> None:
    with closing(sqlite3.connect(database)) as other:
        other.execute("UPDATE alembic_version SET version_num = 'abc123'")
        other.commit()
    refused(
        database,
        r"another version of MLflow \(schema abc123, MLflow .* needs .*\);"
        r" make a copy and run `mlflow db upgrade",
    )


def test_an_older_database_is_not_upgraded_behind_the_users_back(database: Path) -> None:
    with closing(sqlite3.connect(database)) as other:
        other.execute("UPDATE alembic_version SET version_num = 'abc123'")
        other.execute("DROP TABLE logged_models")
        other.commit()
    refused(database, "another version of MLflow")


def test_a_folder_in_the_place_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").mkdir()
    refused(tmp_path / "mlflow.db", "is a folder, not an MLflow database")


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(
        TrackingError, match="file/store: the folder of the MLflow store cannot be made"
    ):
        open_store(f"sqlite:///{tmp_path}/file/store/mlflow.db", "cfx")


def test_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Tests may run as root, whom no permission stops.
    monkeypatch.setattr(store.os, "access", lambda *_: False)
    with pytest.raises(
        TrackingError,
        match=f"{re.escape(str(tmp_path))}: the folder of the MLflow store cannot be written",
    ):
        open_store(f"sqlite:///{tmp_path}/mlflow.db", "cfx")


def test_a_lock_that_is_never_released(tmp_path: Path, database: Path) -> None:
    from filelock import FileLock

    with FileLock(tmp_path / "mlflow.db.lock"):
        refused(database, "another process holds the lock of the MLflow store")


def test_an_experiment_that_was_deleted(database: Path) -> None:
    opened = open_store(f"sqlite:///{database}", "cfx")
    opened.client.delete_experiment(opened.experiment_id)
    with pytest.raises(TrackingError, match="the experiment 'cfx' is deleted in sqlite:"):
        open_store(f"sqlite:///{database}", "cfx")


def test_an_empty_file_becomes_a_database(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").touch()
    assert open_store(f"sqlite:///{tmp_path}/mlflow.db", "mine").experiment_id == "1"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mlflow.db", "mlflow.db.lock"]


def test_a_server_that_does_not_answer() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(
        TrackingError, match=f"no MLflow server answers at http://127.0.0.1:{port} "
    ):
        open_store(f"http://127.0.0.1:{port}", "cfx")


def test_the_address_is_the_jobs_then_the_environments_then_beside_the_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tracking_uri(None) == f"sqlite:///{tmp_path}/outputs/mlflow.db"
    assert tracking_uri("sqlite:///mine/a.db") == f"sqlite:///{tmp_path}/mine/a.db"
    assert tracking_uri("http://host:5000") == "http://host:5000"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///env.db")
    assert tracking_uri("sqlite:///mine/a.db") == f"sqlite:///{tmp_path}/mine/a.db"
    assert tracking_uri(None) == f"sqlite:///{tmp_path}/env.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "")
    assert tracking_uri("postgresql+psycopg2://u@h/db") == "postgresql+psycopg2://u@h/db"


@pytest.mark.parametrize(
    "uri",
    [
        "mlruns",
        "file:///tmp/mlruns",
        "outputs/mlflow.db",
        "ftp://host",
        "sqlite:///",
        "sqlite:///:memory:",
        "sqlite://",
    ],
)
def test_an_address_that_is_none(uri: str) -> None:
    with pytest.raises(TrackingError, match=r"^tracking.uri=.*write sqlite:///FILE"):
        tracking_uri(uri)
