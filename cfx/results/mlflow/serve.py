"""Opens the tracked jobs in MLflow's own user interface, reachable from this machine only."""

from __future__ import annotations

import hashlib
import itertools
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
from cfx.evaluation.headline import PERCENT, RESULT, TESTED

if TYPE_CHECKING:
    from mlflow import MlflowClient

HOST = "127.0.0.1"

SWEEPS = 3
"""How many sweeps, the newest, are listed."""

JOBS = 3
"""How many jobs that belong to no sweep, the newest, are listed."""

COMPARED = 10
"""Most jobs on one page that compares them side by side; the best of a larger sweep."""

_BEFORE_ERROR = ("tags.`model`", "tags.`policy`", "tags.`learner`", f"tags.`{RESULT}`")
_AFTER_ERROR = (
    f"metrics.`{PERCENT}`",
    "metrics.`collisions`",
    f"tags.`{TESTED}`",
    "tags.`protocol`",
    "tags.`data`",
    "tags.`optimizer`",
    "tags.`objective`",
    "tags.`style.cluster`",
    "tags.`seed`",
)
"""Columns of the tables of jobs: what it is and its result come first, then the error by which the
table is sorted. Jobs with another `TESTED` do not compare."""

_WIDTHS = {
    "tags.`model`": 84,
    "tags.`policy`": 64,
    "tags.`learner`": 84,
    f"tags.`{RESULT}`": 260,
}
"""Pixels of columns that need more or less than MLflow gives them."""

_SECTION = "cfx"

_DIFFERENCE = {
    "uuid": "cfx-difference",
    "type": "DIFFERENCE",
    "chartName": "Settings that differ",
    "compareGroups": ["Parameters"],
    "showChangeFromBaseline": False,
    "showDifferencesOnly": True,
    "baselineColumnUuid": "",
    "runsCountToCompare": 10,
}
"""The chart beside those of the error and of the improvement, before those that MLflow makes."""

_READY_S = 120.0
"""How long the server may take to answer, s."""


def serve(uri: str | None, port: int, *, open_browser: bool = False) -> None:
    """Starts MLflow's server on a tracking store and prints the links.

    This process becomes the server until Ctrl-C. Runs that a killed process left RUNNING are closed
    first. The columns of the linked tables are kept in the store.

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
        _open_later(port, _first_link(lines))
    _become_server(store, port)


def _first_link(lines: Sequence[str]) -> str:
    """Returns the first link in lines that people read."""
    _, scheme, text = " ".join(lines).partition("http://")
    return scheme + text.split()[0]


def _become_server(store: str, port: int) -> None:
    """Puts MLflow's server in this process's place, so that signals and exit codes are its own."""
    command = [sys.executable, "-m", "mlflow", "ui", "--host", HOST, "--port", str(port)]
    command += ["--workers", "1", "--backend-store-uri", store]
    environment = {
        **os.environ,
        "PYTHONWARNINGS": "ignore",  # MLflow's own libraries warn of each other
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    }
    os.execve(sys.executable, command, environment)  # noqa: S606 - no shell is wanted


def open_when_ready(port: str, link: str) -> None:
    """Opens a link in the user's browser once MLflow's server answers at `port`.

    Gives up silently after two minutes.
    """
    end = time.monotonic() + _READY_S
    while time.monotonic() < end:
        try:
            with urllib.request.urlopen(f"http://{HOST}:{port}/health", timeout=5):
                webbrowser.open(link)
                return
        except OSError:
            time.sleep(0.2)


def _open_later(port: int, link: str) -> None:
    code = (
        "import sys; from cfx.results.mlflow.serve import open_when_ready;"
        " open_when_ready(*sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, str(port), link]
    subprocess.Popen(command)  # noqa: S603 - this interpreter, and what is written above


def _store(uri: str | None) -> str:
    from cfx.results.mlflow.store import absolute_uri, check_database, sqlite_file, tracking_uri

    store = tracking_uri(None)
    if uri:
        store = absolute_uri(uri, "--uri")
    file = sqlite_file(store)
    if file is not None and not file.is_file():
        raise TrackingError(
            f"{file} does not exist: no job has been tracked from here;"
            " run one, or name its store with --uri"
        )
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


def _client(store: str) -> MlflowClient:
    from mlflow import MlflowClient

    return MlflowClient(store)


def _close_abandoned(store: str) -> None:
    """Marks runs KILLED that a killed process left RUNNING."""
    from cfx.results.mlflow.store import open_store, translate_errors
    from cfx.results.mlflow.tracker import close_abandoned

    with translate_errors(f"close abandoned runs in {store}"):
        for experiment in _client(store).search_experiments():
            opened = open_store(store, experiment.name)
            with opened.locked():
                close_abandoned(opened)


def _links(store: str, port: int) -> list[str]:
    """Returns what to print: the newest sweeps and single jobs, and a page per experiment."""
    from cfx.results.mlflow.store import translate_errors

    with translate_errors(f"read {store}"):
        client = _client(store)
        names = {}
        for experiment in client.search_experiments():
            names[str(experiment.experiment_id)] = str(experiment.name)
        newest = ["attributes.start_time DESC"]
        sweeps = client.search_runs(
            list(names), "tags.`cfx.sweep_parent` LIKE '%'", order_by=newest, max_results=SWEEPS
        )
        alone = "tags.`cfx.sweep` IS NULL and tags.`cfx.sweep_parent` IS NULL"
        jobs = client.search_runs(list(names), alone, order_by=newest, max_results=JOBS)
        address = f"http://{HOST}:{port}/"
        lines = []
        for sweep in sweeps:
            lines += _sweep_lines(client, sweep, address)
        for job in jobs:
            page = f"#/experiments/{job.info.experiment_id}/runs/{job.info.run_id}"
            lines.append(f"job {job.info.run_name}, {_began(job)}{_result(job)}")
            lines.append(f"  page:    {address}{page}?workflowType=machine_learning")
        lines += _experiment_lines(client, names, address)
        return lines


def _sweep_lines(client: MlflowClient, parent: Any, address: str) -> list[str]:
    from cfx.results.mlflow.tracker import common_error

    experiment, name = str(parent.info.experiment_id), parent.data.tags["cfx.sweep_parent"]
    chosen = f"tags.`cfx.sweep` = '{name}'"
    jobs = client.search_runs([experiment], chosen, max_results=1000)
    error = common_error(jobs)
    groups = _over_seeds(jobs, error)
    runs = list(itertools.chain.from_iterable(groups))
    table = _shared_view(client, experiment, chosen, error)
    title = f"sweep {name}, {_began(parent)}: {len(runs)} jobs"
    if groups:
        title += _best(groups[0], error)
    tested = {run.data.tags.get(TESTED, "") for run in runs}
    tested.discard("")  # of jobs that did not end
    if len(tested) > 1:
        title += f"; tested on {len(tested)} sets of pairs, which do not compare ({TESTED})"
    lines = [
        title,
        f"  table:   {address}{table}",
        f"  charts:  {address}{table}&compareRunsMode=CHART",
    ]
    if len(runs) > 1:
        ids = [str(run.info.run_id) for run in runs[:COMPARED]]
        line = f"  compare: {address}{_compare_page(experiment, ids)}"
        if len(runs) > COMPARED:
            line += f" (the best {COMPARED})"
        lines.append(line)
    return lines


def _over_seeds(runs: Sequence[Any], error: str) -> list[list[Any]]:
    """Returns the runs, those that differ in the seed alone together, the least mean error first.

    A single seed that was lucky so comes before no setting that is better on average.
    """
    groups: dict[tuple[tuple[str, str], ...], list[Any]] = {}
    for run in runs:
        settings = dict(run.data.params)
        settings.pop("seed", None)
        groups.setdefault(tuple(sorted(settings.items())), []).append(run)
    return sorted(groups.values(), key=lambda group: _mean_error(group, error))


def _errors(runs: Sequence[Any], error: str) -> list[float]:
    """Returns the errors of those runs that have one."""
    values = []
    for run in runs:
        value = run.data.metrics.get(error, math.nan)
        if math.isfinite(value):
            values.append(value)
    return values


def _mean_error(runs: Sequence[Any], error: str) -> float:
    """Returns the runs' mean error, infinity if none has one."""
    values = _errors(runs, error)
    return sum(values) / len(values) if values else math.inf


def _best(runs: Sequence[Any], error: str) -> str:
    """Returns the error of the best setting, over its seeds if there are several."""
    values = _errors(runs, error)
    if not values:
        return f", {runs[0].info.status}"
    smallest = f", smallest {error} {_mean_error(runs, error):.3f}"
    return f"{smallest} (mean of {len(values)} seeds)" if len(values) > 1 else smallest


def _experiment_lines(client: MlflowClient, names: dict[str, str], address: str) -> list[str]:
    """Returns a page for each experiment that holds jobs, or for each if none does."""
    from cfx.results.mlflow.tracker import common_error

    used = [experiment for experiment in names if client.search_runs([experiment], max_results=1)]
    lines = []
    for experiment in used or names:
        chosen = "tags.`cfx.sweep_parent` IS NULL"
        jobs = client.search_runs([experiment], chosen, max_results=1000)
        page = _shared_view(client, experiment, chosen, common_error(jobs))
        lines.append(
            f"all jobs of experiment {names[experiment]}, the smallest error first\n"
            f"  table:   {address}{page}"
        )
    return lines


def _shared_view(client: MlflowClient, experiment: str, chosen: str, error: str) -> str:
    """Keeps a view of the table of runs in the store, the least error first; returns its page.

    MLflow hides metrics until a user picks columns; only a "shared view", a tag of the experiment,
    carries columns in a link. The page comes without the server's address.

    Args:
        chosen: MLflow's search for the runs to show.
        error: the metric by which they are sorted.
    """
    widths = dict(_WIDTHS)
    columns = [*_BEFORE_ERROR, f"metrics.`{error}`", *_AFTER_ERROR]
    for column in columns:
        if column.startswith("metrics"):
            widths[column] = 8 * len(column) - 40
    section = {"uuid": _SECTION, "name": "Error and improvement", "display": True}
    always = {"deleted": False, "isGenerated": False, "metricSectionId": _SECTION}
    charts: list[dict[str, Any]] = []
    for metric in (error, PERCENT):
        bars = {"type": "BAR", "metricKey": metric, "runsCountToCompare": 20}
        charts.append({"uuid": f"cfx-{metric}", **bars, **always})
    charts.append({**_DIFFERENCE, **always})
    view = {
        "searchFilter": chosen,
        # Sorted by date, MLflow would fold jobs away under their sweep.
        "orderByKey": f"metrics.`{error}`",
        "orderByAsc": True,
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": widths,
        "chartsSearchFilter": f"{error}|{PERCENT}",
        "isAccordionReordered": True,  # else MLflow sorts the sections by their names
        "compareRunSections": [
            {**section, "isReordered": False, "deleted": False, "isGenerated": False}
        ],
        "compareRunCharts": charts,
    }
    key = "cfx-" + hashlib.sha256(chosen.encode()).hexdigest()[:12]
    client.set_experiment_tag(experiment, f"mlflow.sharedViewState.{key}", json.dumps(view))
    return f"#/experiments/{experiment}/runs?viewStateShareKey={key}&workflowType=machine_learning"


def _compare_page(experiment: str, ids: Sequence[str]) -> str:
    runs = quote(json.dumps(list(ids), separators=(",", ":")))
    experiments = quote(json.dumps([experiment], separators=(",", ":")))
    return f"#/compare-runs?runs={runs}&experiments={experiments}"


def _began(run: Any) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(run.info.start_time / 1000))


def _result(run: Any) -> str:
    """Returns a run's result in words; how the run ended if it has none."""
    return f", {run.data.tags.get(RESULT) or run.info.status}"
