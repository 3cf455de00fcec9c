"""The MLflow store: where it is, whether it is an MLflow store, and how to open it without harm.

MLflow itself waits minutes for a database that cannot be opened, adds its tables to any SQLite file
that it is pointed at, and crashes when several processes make a new database at once. So the file
is examined first, and made under a lock.
"""

from __future__ import annotations

import logging
import os
import re
import sqlite3
import urllib.error
import urllib.request
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import BaseFileLock, Timeout

from cfx.core.files import lock_for
from cfx.errors import TrackingError

if TYPE_CHECKING:
    from mlflow import MlflowClient

LOCK_SECONDS = 15.0
"""How long a job waits at its start for a database that another process holds.

Jobs of a sweep hold it for milliseconds.
"""

_TURNS = 20
"""How many times as long a job waits for its turn among hundreds that start at once."""

_PATIENCE_S = 60
"""How long a later write waits: the work is done by then, and worth the wait."""

_BAR = "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR"
_DATABASES = ("postgresql", "mysql", "mssql")
_SERVERS = ("http", "https", "databricks", "databricks-uc", "uc")
_HOW = "set tracking.uri=sqlite:///FILE to use another"


@dataclass(frozen=True)
class Store:
    """An MLflow store that has been examined and opened.

    Attributes:
        uri: absolute, as `mlflow ui --backend-store-uri` takes it.
        client: MLflow's client for it; there is no global state.
        experiment_id: the experiment that the jobs log to.
        lock: held around what must not happen twice at once.
    """

    uri: str
    client: MlflowClient
    experiment_id: str
    lock: BaseFileLock

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Holds the lock.

        Raises:
            TrackingError: another process does not let go of it.
        """
        with _held(self.lock):
            yield


def default_store() -> Path:
    """Returns where the database is by default: beside the outputs."""
    return Path("outputs/mlflow.db").absolute()


def tracking_uri(configured: str | None, default: Path | None = None) -> str:
    """Returns the tracking URI, always absolute.

    It is the config's, which somebody has set for this job; else `MLFLOW_TRACKING_URI`; else SQLite
    at `default`.

    Raises:
        TrackingError: it is neither a database nor a server.
    """
    if configured:
        return absolute_uri(configured, "tracking.uri")
    of_environment = os.environ.get("MLFLOW_TRACKING_URI")
    if of_environment:
        return absolute_uri(of_environment, "MLFLOW_TRACKING_URI")
    return absolute_uri(f"sqlite:///{default or default_store()}", "tracking.uri")


def absolute_uri(uri: str, said_by: str) -> str:
    """Returns a tracking URI with an absolute path.

    Args:
        said_by: where a user wrote it, for the message.

    Raises:
        TrackingError: it is neither a database nor a server.
    """
    scheme = uri
    if "://" in uri:
        scheme = uri.split("://", 1)[0].split("+", 1)[0]
    if scheme == "sqlite":
        name = uri.removeprefix("sqlite:///")
        if name == uri or name in {"", ":memory:"}:
            raise TrackingError(f"{said_by}={uri}: an SQLite store is a file; write sqlite:///FILE")
        return f"sqlite:///{Path(name).expanduser().absolute()}"
    if scheme not in _DATABASES + _SERVERS:
        raise TrackingError(
            f"{said_by}={uri}: MLflow needs a database or a server;"
            " write sqlite:///FILE or http://HOST:PORT"
        )
    return uri


def open_store(uri: str, experiment: str, default: Path | None = None) -> Store:
    """Opens a store; makes database and experiment where they are not there yet.

    Many processes may do so at once.

    Args:
        uri: as `tracking_uri` returns it.
        experiment: the experiment's name.
        default: path whose folder takes the lock and the artifacts where the store itself is not a
            file.

    Raises:
        TrackingError: the store is locked, foreign, of another MLflow version, unreachable, or
            cannot be written.
    """
    file = sqlite_file(uri)
    home = (file or default or default_store()).parent
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrackingError(
            f"{home}: the folder of the MLflow store cannot be made ({error.strerror}); {_HOW}"
        ) from error
    if not os.access(home, os.W_OK | os.X_OK):
        raise TrackingError(f"{home}: the folder of the MLflow store cannot be written; {_HOW}")
    name = "mlflow"
    if file is not None:
        name = file.name
    # Not while the lock is held: on a busy machine it takes each of many jobs a minute.
    with quiet():
        _import_databases()
    lock = lock_for(home / f"{name}.lock", timeout=_TURNS * LOCK_SECONDS)
    with _held(lock):
        if file is not None:
            if _is_new(file):
                _create(file, home)
            else:
                check_database(file, uri)
        else:
            _answers(uri)
        with translate_errors(f"open {uri}"):
            from mlflow import MlflowClient

            address = uri
            if file is not None:
                address = f"{uri}?timeout={_PATIENCE_S}"
            client = MlflowClient(tracking_uri=address)
            # A server has a place for artifacts of its own.
            is_server = uri.split("://", maxsplit=1)[0] in _SERVERS
            experiment_id = _experiment(client, uri, experiment, None if is_server else home)
    return Store(uri, client, experiment_id, lock)


def sqlite_file(uri: str) -> Path | None:
    """Returns the file of an SQLite URI, None for any other store."""
    if not uri.startswith("sqlite:///"):
        return None
    return Path(uri.removeprefix("sqlite:///"))


def artifact_folder(home: Path) -> Path:
    """Returns where artifacts lie: beside the database."""
    return home / "mlartifacts"


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps MLflow's and Alembic's messages and warnings off the terminal while it holds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _import_mlflow()
        bar = os.environ.get(_BAR)
        os.environ[_BAR] = "false"
        loggers = [logging.getLogger(name) for name in ("mlflow", "alembic")]
        root = logging.getLogger()
        levels = [logger.level for logger in loggers]
        handlers, root_level = root.handlers[:], root.level
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
            root.handlers[:] = handlers
            root.setLevel(root_level)
            os.environ.pop(_BAR)
            if bar is not None:
                os.environ[_BAR] = bar


_DRIVERS = {
    "psycopg": "psycopg[binary]",
    "psycopg2": "psycopg2-binary",
    "MySQLdb": "mysqlclient",
    "pymysql": "PyMySQL",
}
"""Packages of database drivers, by the module that is imported."""


@contextmanager
def translate_errors(doing: str) -> Iterator[None]:
    """Runs MLflow quietly; what goes wrong becomes one sentence that says what it was doing.

    Raises:
        TrackingError: MLflow, the database or the file system refused.
    """
    with quiet():
        from mlflow.exceptions import MlflowException
        from sqlalchemy.exc import SQLAlchemyError

        try:
            yield
        except ImportError as error:
            package = _DRIVERS.get(str(error.name), str(error.name))
            raise TrackingError(
                f"MLflow could not {doing}: the database's driver is not installed; pip install"
                f" {package}"
            ) from error
        except (MlflowException, SQLAlchemyError, sqlite3.Error, OSError) as error:
            reason = _first_line(error)
            if "database is locked" in str(error):
                reason = (
                    "the database is locked by another process; close what holds it and run again"
                )
            raise TrackingError(f"MLflow could not {doing}: {reason[:300]}") from error


def _first_line(error: Exception) -> str:
    """Returns the first line of an error's text that is not empty; its type if it has none."""
    for line in str(error).splitlines():
        if line.strip():
            return line.strip()
    return type(error).__name__


def is_run_id(text: str) -> bool:
    """Says whether this could be the id of an MLflow run."""
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


def download_run(run_id: str, uri: str | None = None) -> Path:
    """Returns a folder with the files of a tracked job.

    They are those that a job's folder has, such as `metrics.json`, `pairs.csv` and `policy/`.

    Args:
        run_id: MLflow's id of the run.
        uri: of the store; None for `MLFLOW_TRACKING_URI`, else the database beside the outputs.

    Raises:
        TrackingError: there is no such run, or its files are gone.
    """
    address = tracking_uri(uri)
    file = sqlite_file(address)
    if file is not None and not file.is_file():
        raise TrackingError(
            f"'{run_id}' is no folder, and there is no MLflow database at {file} in which it"
            " could be a run"
        )
    if not is_run_id(run_id):
        raise TrackingError(
            f"'{run_id}' is neither a job's output folder nor the id of an MLflow run"
            " (32 digits and letters a to f)"
        )
    store = open_store(address, "cfx")
    with translate_errors(f"read run {run_id} from {address}"):
        return Path(store.client.download_artifacts(run_id, ""))


def _import_databases() -> None:
    """Imports what MLflow imports for its first answer: SQLAlchemy, Alembic and its own stores."""
    _import_mlflow()
    import mlflow.store.db.utils
    import mlflow.store.tracking.sqlalchemy_store  # noqa: F401 - imported for later


def _import_mlflow() -> Any:
    # It reports its use to its makers unless told not to; nothing goes to the network unasked.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    import mlflow

    return mlflow


@contextmanager
def _held(lock: BaseFileLock) -> Iterator[None]:
    try:
        lock.acquire()
    except Timeout as error:
        raise TrackingError(
            f"{lock.lock_file}: another process holds the lock of the MLflow store;"
            f" end it, or {_HOW}"
        ) from error
    except OSError as error:
        raise TrackingError(
            f"{lock.lock_file}: the lock of the MLflow store cannot be made ({error.strerror});"
            f" {_HOW}"
        ) from error
    try:
        yield
    finally:
        lock.release()


def _is_new(file: Path) -> bool:
    if file.is_dir():
        raise TrackingError(f"{file} is a folder, not an MLflow database; {_HOW}")
    return not file.exists() or file.stat().st_size == 0


def _create(file: Path, home: Path) -> None:
    """Makes a new database under a name of its own and moves it into place.

    So no other process ever sees half of one.
    """
    partial = file.with_name(f".{file.name}.{os.getpid()}.part")
    partial.unlink(missing_ok=True)
    try:
        with translate_errors(f"make the database {file}"), _unsynchronised():
            from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

            store = SqlAlchemyStore(  # type: ignore[no-untyped-call]  # MLflow's
                f"sqlite:///{partial}", artifact_folder(home).as_uri()
            )
            store.engine.dispose()
            with partial.open("rb+") as made:
                os.fsync(made.fileno())
            partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _unsynchronised() -> Iterator[None]:
    """Lets SQLite not wait for the disk after each of MLflow's migrations: 1 s instead of 6.

    Only for a file of this process: if the machine fails meanwhile, it is lost, and made
    again.
    """
    from sqlalchemy import event
    from sqlalchemy.engine import Engine

    def relax(connection: Any, record: Any) -> None:  # noqa: ARG001 - SQLAlchemy's signature
        connection.execute("PRAGMA synchronous = OFF")

    event.listen(Engine, "connect", relax)
    try:
        yield
    finally:
        event.remove(Engine, "connect", relax)


def check_database(file: Path, uri: str) -> None:
    """Examines an existing SQLite file before MLflow does.

    Raises:
        TrackingError: it is locked, or no database of this version of MLflow.
    """
    try:
        versions = _schema_versions(file)
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            raise TrackingError(
                f"{file}: the MLflow database is locked by another process;"
                f" close what holds it and run again, or {_HOW}"
            ) from error
        raise TrackingError(
            f"{file}: the MLflow database cannot be opened for writing ({error}); {_HOW}"
        ) from error
    except sqlite3.DatabaseError as error:
        raise TrackingError(f"{file} is not an SQLite database ({error}); {_HOW}") from error
    if versions is None:
        raise TrackingError(f"{file} is an SQLite database, but not MLflow's; {_HOW}")
    with quiet():
        import mlflow
        from mlflow.store.db.utils import _get_latest_schema_revision

        wanted = _get_latest_schema_revision()  # type: ignore[no-untyped-call]  # MLflow's
    if versions != [wanted]:
        raise TrackingError(
            f"{file} was written by another version of MLflow"
            f" (schema {', '.join(versions) or 'unknown'},"
            f" MLflow {mlflow.__version__} needs {wanted}); make a copy and run"
            f" `mlflow db upgrade {uri}`, or {_HOW}"
        )


def _schema_versions(file: Path) -> list[str] | None:
    """Returns the versions of the schema that an SQLite file names; None if it is not MLflow's.

    Raises:
        sqlite3.Error: the file is locked, or no database.
    """
    # Autocommit mode: the transaction is this function's own.
    connection = sqlite3.connect(
        file.as_uri() + "?mode=rw", uri=True, timeout=LOCK_SECONDS, isolation_level=None
    )
    try:
        connection.execute("BEGIN IMMEDIATE")
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        if not {("alembic_version",), ("experiments",), ("runs",)} <= set(names):
            return None
        rows = connection.execute("SELECT version_num FROM alembic_version").fetchall()
        return [str(row[0]) for row in rows]
    finally:
        connection.close()


def _answers(uri: str) -> None:
    """Asks a server for a sign of life: MLflow itself would try for minutes."""
    if not uri.startswith(("http://", "https://")):
        return
    try:
        health = f"{uri.rstrip('/')}/health"
        with urllib.request.urlopen(health, timeout=LOCK_SECONDS):  # noqa: S310 - http or https, the user's own
            pass
    except urllib.error.HTTPError:
        pass  # it answers; whether it grants access shows at the first call
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise TrackingError(
            f"no MLflow server answers at {uri} ({reason}); start it, or {_HOW}"
        ) from error


def _experiment(client: MlflowClient, uri: str, name: str, home: Path | None) -> str:
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        location = None
        if home is not None:
            location = artifact_folder(home).as_uri()
        return str(client.create_experiment(name, artifact_location=location))
    if experiment.lifecycle_stage != "active":
        raise TrackingError(
            f"the experiment '{name}' is deleted in {uri}; restore it there, or set"
            " tracking.experiment to another name"
        )
    return str(experiment.experiment_id)
