"""MLflow's store may be a PostgreSQL database, which many machines write to at once."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("psycopg", reason='pip install "cfx-driving[postgresql]"')

USER = "postgres"


def programs() -> Path | None:
    """Returns the folder of PostgreSQL's programs, as Debian installs them."""
    for found in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        return found
    initdb = shutil.which("initdb")
    return None if initdb is None else Path(initdb).parent


def command(*words: str | Path) -> None:
    """Runs one of PostgreSQL's programs, which refuse to work as root."""
    user = USER if os.getuid() == 0 else None
    subprocess.run(words, check=True, capture_output=True, user=user, timeout=120)


@pytest.fixture
def database() -> Iterator[str]:
    """Yields the address of an empty database on this machine."""
    found = programs()
    if found is None:
        pytest.skip("PostgreSQL is not installed (apt-get install postgresql)")
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        port = str(server.getsockname()[1])
    folder = Path(tempfile.mkdtemp(prefix="cfx-postgresql-"))
    if os.getuid() == 0:
        shutil.chown(folder, USER)
    data, log = folder / "data", folder / "log"
    options = f"-c listen_addresses=127.0.0.1 -p {port} -k {folder}"
    try:
        command(found / "initdb", "-D", data, "-A", "trust", "-U", "cfx")
        command(found / "pg_ctl", "-D", data, "-l", log, "-o", options, "-w", "start")
        command(found / "createdb", "-h", "127.0.0.1", "-p", port, "-U", "cfx", "mlflow")
        yield f"postgresql+psycopg://cfx@127.0.0.1:{port}/mlflow"
    finally:
        subprocess.run(
            [found / "pg_ctl", "-D", data, "-m", "immediate", "stop"],
            check=False,
            capture_output=True,
            user=USER if os.getuid() == 0 else None,
        )
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # inside MLflow
@pytest.mark.filterwarnings("ignore::UserWarning")  # inside MLflow, at its import
def test_a_sweep_of_two_processes_is_tracked_in_postgresql(database: str, tmp_path: Path) -> None:
    began = time.monotonic()
    done = subprocess.run(
        [
            *(sys.executable, "-m", "cfx", "-m", "debug=quick", "seed=0,1", "cores=1"),
            *("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "figures=none"),
            f"tracking.uri={database}",
        ],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 of 2 jobs done" in done.stdout, time.monotonic() - began
    import mlflow

    client = mlflow.MlflowClient(database)
    experiment = client.get_experiment_by_name("cfx-debug")
    assert experiment is not None
    runs = client.search_runs([experiment.experiment_id])
    children = [run for run in runs if "mlflow.parentRunId" in run.data.tags]
    assert [run.info.status for run in children] == ["FINISHED"] * 2
    assert {run.data.params["seed"] for run in children} == {"0", "1"}
    assert "RUNNING" not in {run.info.status for run in runs}
