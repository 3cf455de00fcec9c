"""Opens the tracked jobs in MLflow's own user interface, reachable from this machine only."""

from __future__ import annotations

import hashlib
import json
import math
import os
import socket
import subprocess
import sys
import time
import urllib.request
import webbrowser
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from cfx.errors import ConfigError, TrackingError

if TYPE_CHECKING:
    from mlflow import MlflowClient

HOST = "127.0.0.1"

SWEEPS = 3
"""How many sweeps, the newest, are listed."""

JOBS = 3
"""How many jobs that belong to no sweep, the newest, are listed."""

COMPARED = 10
"""Most jobs on one page that compares them side by side; the best of a larger sweep."""

IMPROVEMENT = "metrics.`rmse_improvement/mean`"
_COLUMNS = (
    IMPROVEMENT,
    *(f"metrics.`rmse_improvement/{name}`" for name in ("ci95_low", "ci95_high", "win_rate")),
    *(f"metrics.`rmse_speed/{method}`" for method in ("policy", "fixed", "default")),
    "metrics.`collisions/policy`",
    *(
        f"tags.`{kind}`"
        for kind in ("model", "policy", "optimizer", "data", "style.cluster", "seed")
    ),
)
_CHARTS = "rmse_(improvement/mean|speed)"
_READY_S = 120.0


def serve(uri: str | None, port: int, *, open_browser: bool = False) -> None:
    """Starts MLflow's server on a tracking store and prints the links; this process becomes the server until Ctrl-C.

    Runs that a killed process left RUNNING are closed first. The columns of the linked tables are kept in the store.

    Args:
        uri: of the store; None for `MLFLOW_TRACKING_URI`, else the database beside the outputs.
        port: of the server, on 127.0.0.1.
        open_browser: open the first link in the user's browser, as soon as the server answers.

    Raises:
        ConfigError: the port is taken.
        TrackingError: the store does not exist or cannot be read.
    """
    store = _store(uri)
    if store.startswith(("http://", "https://")):
        print(f"the tracking store is a server already; open {store}")
        return
    _check_port(port)
    _close_abandoned(store)
    lines = _links(store, port)
    for line in lines:
        print(line, flush=True)
    if open_browser:
        _open_later(
            port,
            next(word for line in lines for word in line.split() if word.startswith("http://")),
        )
    # MLflow's own libraries warn of each other; that is nothing to a user.
    quietly = {
        "PYTHONWARNINGS": "ignore",
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    }
    command = [
        "mlflow",
        "ui",
        "--host",
        HOST,
        "--port",
        str(port),
        "--workers",
        "1",
        "--backend-store-uri",
        store,
    ]
    # The server takes this process's place, so that signals and exit codes are its own.
    os.execve(sys.executable, [sys.executable, "-m", *command], {**os.environ, **quietly})  # noqa: S606 - no shell is wanted


def open_when_ready(port: str, link: str) -> None:
    """Opens a link in the user's browser once MLflow's server answers at `port`; gives up silently after two minutes."""
    end = time.monotonic() + _READY_S
    while time.monotonic() < end:
        try:
            with urllib.request.urlopen(f"http://{HOST}:{port}/health", timeout=5):
                webbrowser.open(link)
                return
        except OSError:
            time.sleep(0.2)


def _open_later(port: int, link: str) -> None:
    code = "import sys; from cfx.ui import open_when_ready; open_when_ready(*sys.argv[1:])"
    subprocess.Popen([sys.executable, "-c", code, str(port), link])  # noqa: S603 - this interpreter, and what is written above


def _store(uri: str | None) -> str:
    from cfx.tracking.store import absolute_uri, check_database, sqlite_file, tracking_uri

    store = absolute_uri(uri, "--uri") if uri else tracking_uri(None)
    file = sqlite_file(store)
    if file is not None and not file.is_file():
        raise TrackingError(
            f"{file} does not exist: no job has been tracked from here; run one, or name its store with --uri"
        )
    if file is not None:
        check_database(file, store)
    return store


def _check_port(port: int) -> None:
    with socket.socket() as smoke_check:
        smoke_check.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            smoke_check.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"--port {port} cannot be used ({error}); choose another") from None


def _client(store: str) -> MlflowClient:
    from mlflow import MlflowClient

    return MlflowClient(store)


def _close_abandoned(store: str) -> None:
    """Marks runs KILLED that a killed process left RUNNING."""
    from cfx.tracking.store import open_store, translate_errors
    from cfx.tracking.tracker import close_abandoned

    with translate_errors(f"close abandoned runs in {store}"):
        names = [one.name for one in _client(store).search_experiments()]
        for name in names:
            opened = open_store(store, name)
            with opened.locked():
                close_abandoned(opened)


def _links(store: str, port: int) -> list[str]:
    """Returns what to print: the newest sweeps and the newest single jobs with their pages, and a page per experiment."""
    from cfx.tracking.store import translate_errors

    with translate_errors(f"read {store}"):
        client = _client(store)
        names = {str(one.experiment_id): str(one.name) for one in client.search_experiments()}
        newest = ["attributes.start_time DESC"]
        sweeps = client.search_runs(
            list(names), "tags.`cfx.sweep_parent` LIKE '%'", order_by=newest, max_results=SWEEPS
        )
        alone = "tags.`cfx.sweep` IS NULL and tags.`cfx.sweep_parent` IS NULL"
        jobs = client.search_runs(list(names), alone, order_by=newest, max_results=JOBS)
        address = f"http://{HOST}:{port}/"
        lines = [line for sweep in sweeps for line in _sweep_lines(client, sweep, address)]
        for job in jobs:
            page = f"#/experiments/{job.info.experiment_id}/runs/{job.info.run_id}?workflowType=machine_learning"
            lines += [
                f"job {job.info.run_name}, {_began(job)}{_improvement(job)}",
                f"  page:    {address}{page}",
            ]
        return [*lines, *_experiment_lines(client, names, address)]


def _sweep_lines(client: MlflowClient, parent: Any, address: str) -> list[str]:
    experiment, name = str(parent.info.experiment_id), parent.data.tags["cfx.sweep_parent"]
    chosen = f"tags.`cfx.sweep` = '{name}'"
    found = client.search_runs(
        [experiment], chosen, order_by=[f"{IMPROVEMENT} DESC"], max_results=1000
    )
    table = _shared_view(client, experiment, chosen)
    title = f"sweep {name}, {_began(parent)}: {len(found)} jobs" + (
        _improvement(found[0], "best ") if found else ""
    )
    lines = [
        title,
        f"  table:   {address}{table}",
        f"  charts:  {address}{table}&compareRunsMode=CHART",
    ]
    if len(found) > 1:
        best = "" if len(found) <= COMPARED else f" (the best {COMPARED})"
        ids = [str(run.info.run_id) for run in found[:COMPARED]]
        lines.append(f"  compare: {address}{_compare_page(experiment, ids)}{best}")
    return lines


def _experiment_lines(client: MlflowClient, names: dict[str, str], address: str) -> list[str]:
    """Returns a page for each experiment that holds jobs, or for each if none does."""
    used = [one for one in names if client.search_runs([one], max_results=1)]
    pages = {
        one: _shared_view(client, one, "tags.`cfx.sweep_parent` IS NULL") for one in used or names
    }
    return [
        f"all jobs of experiment {names[one]}, the best first\n  table:   {address}{page}"
        for one, page in pages.items()
    ]


def _shared_view(client: MlflowClient, experiment: str, chosen: str) -> str:
    """Keeps a view of the table of runs in the store, the best first, and returns its page without the server's address.

    MLflow hides metrics until a user picks columns; only a "shared view", a tag of the experiment, carries columns in a link.

    Args:
        chosen: MLflow's search for the runs to show.
    """
    view = {
        "searchFilter": chosen,
        "orderByKey": IMPROVEMENT,  # sorted by date, MLflow would fold jobs away under their sweep
        "orderByAsc": False,
        "selectedColumns": list(_COLUMNS),
        "columnOrder": list(_COLUMNS),
        "columnWidths": {
            column: 8 * len(column) - 40 for column in _COLUMNS if column.startswith("metrics")
        },
        "chartsSearchFilter": _CHARTS,
    }
    key = "cfx-" + hashlib.sha256(chosen.encode()).hexdigest()[:12]
    client.set_experiment_tag(experiment, f"mlflow.sharedViewState.{key}", json.dumps(view))
    return f"#/experiments/{experiment}/runs?viewStateShareKey={key}&workflowType=machine_learning"


def _compare_page(experiment: str, ids: Sequence[str]) -> str:
    runs, experiments = (
        quote(json.dumps(one, separators=(",", ":"))) for one in (list(ids), [experiment])
    )
    return f"#/compare-runs?runs={runs}&experiments={experiments}"


def _began(run: Any) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(run.info.start_time / 1000))


def _improvement(run: Any, which: str = "") -> str:
    value = run.data.metrics.get("rmse_improvement/mean")
    return (
        f", {run.info.status}"
        if value is None or math.isnan(value)
        else f", {which}improvement {value:.1%}"
    )
