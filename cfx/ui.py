"""Opens the tracked jobs in MLflow's own user interface, reachable from this machine only."""

from __future__ import annotations

import os
import socket
import sys

from cfx.errors import ConfigError, TrackingError

HOST = "127.0.0.1"


def serve(uri: str | None, port: int) -> None:
    """Starts MLflow's server on a tracking store and prints the links; this process becomes the server until Ctrl-C.

    Raises:
        ConfigError: the port is taken.
        TrackingError: the store does not exist or cannot be read.
    """
    store = _store(uri)
    if store.startswith(("http://", "https://")):
        print(f"the tracking store is a server already; open {store}")
        return
    _check_port(port)
    for line in _links(store, port):
        print(line, flush=True)
    environment = {**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    command = ["mlflow", "ui", "--host", HOST, "--port", str(port), "--workers", "1", "--backend-store-uri", store]
    # The server takes this process's place, so that signals and exit codes are its own.
    os.execve(sys.executable, [sys.executable, "-m", *command], environment)  # noqa: S606 - no shell is wanted


def _store(uri: str | None) -> str:
    from cfx.tracking.store import check_database, sqlite_file, tracking_uri

    store = uri or tracking_uri(None)
    file = sqlite_file(store)
    if file is not None and not file.is_file():
        raise TrackingError(f"{file} does not exist: no job has been tracked from here; run one, or name its store with --uri")
    if file is not None:
        check_database(file, store)
    return store


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"--port {port} cannot be used ({error}); choose another") from None


def _links(store: str, port: int) -> list[str]:
    """Returns a line per experiment."""
    from cfx.tracking.store import quiet, told

    with quiet(), told(f"read {store}"):
        from mlflow import MlflowClient

        experiments = MlflowClient(store).search_experiments()
    address = f"http://{HOST}:{port}/#/experiments"
    charts = "runs?compareRunsMode=CHART&workflowType=machine_learning"
    return [f"{one.name}: {address}/{one.experiment_id}/{charts}" for one in experiments]
