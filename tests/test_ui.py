"""`python -m cfx ui` as a user meets it: its server, its links, and what a browser shows."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from cfx.app import cli
from cfx.results.mlflow.serve import _best, _over_seeds
from cfx.results.mlflow.store import quiet
from cfx.results.mlflow.tracker import MlflowTracker
from tests.browser import Browser

RESULTS = {"krauss": (0.4321, 12.3), "w99": (0.3456, 23.4), "w74": (0.5678, -5.7)}
"""By model the error, m/s, and the improvement, %."""
SWEEP = "2026-05-04_10-11-12"


@dataclass(frozen=True)
class Served:
    """A running server.

    Attributes:
        lines: what it printed before it served.
        opened: the file to which the user's browser, a stand-in, writes what it is told to open.
        abandoned: the run whose process was killed.
    """

    store: str
    lines: list[str]
    opened: Path
    abandoned: str

    def link(self, name: str, after: str) -> str:
        """Returns the page `name` of the first entry whose title starts with `after`."""
        start = next(k for k, line in enumerate(self.lines) if line.startswith(after))
        return next(
            line.split()[1] for line in self.lines[start:] if line.strip().startswith(f"{name}:")
        )


def fill(store: str) -> str:
    """Tracks a sweep of three jobs, a single one, and a killed one; returns the last one's id."""
    for model, (error, improvement) in RESULTS.items():
        tags = {"model": model, "policy": "gru", "learner": "rollout", "cfx.folder": model}
        tags |= {"result": f"{improvement:+.1f}% over driver-specific", "error": "rmse_speed_mps"}
        with MlflowTracker.run(
            store,
            run_name=f"{model}-gru",
            parameters={"model": model, "seed": "0"},
            tags=tags,
            sweep=SWEEP,
        ) as run:
            run.log_metrics({"improvement_percent": improvement, "rmse_speed_mps": error})
    with MlflowTracker.run(store, run_name="a single job", parameters={"seed": "7"}) as run:
        run.log_metrics({"rmse_speed_mps": 0.3})
    with MlflowTracker.run(store, run_name="killed", parameters={}) as run:
        pass
    # What a killed process leaves: a run that says RUNNING, and by which process, long gone.
    dead = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"],
        capture_output=True,
        text=True,
        check=True,
    )
    run.store.client.set_tag(run.run_id, "cfx.process", f"{dead.stdout.strip()}@1000000000")
    run.store.client.update_run(run.run_id, status="RUNNING")
    return run.run_id


def a_run(model: str, seed: int, error: float) -> SimpleNamespace:
    """Returns a job's run as MLflow gives it."""
    metrics = {"rmse_speed_mps": error}
    data = SimpleNamespace(params={"model": model, "seed": str(seed)}, metrics=metrics)
    return SimpleNamespace(data=data, info=SimpleNamespace(status="FINISHED"))


def test_a_lucky_seed_is_not_the_best_of_a_sweep() -> None:
    lucky = [a_run("w99", 0, 0.30), a_run("w99", 1, 0.60), a_run("w99", 2, math.nan)]
    steady = [a_run("idm", 0, 0.40), a_run("idm", 1, 0.42)]
    groups = _over_seeds([*lucky, *steady], "rmse_speed_mps")
    assert groups == [steady, lucky]
    best = ", smallest rmse_speed_mps 0.410 (mean of 2 seeds)"
    assert _best(groups[0], "rmse_speed_mps") == best
    assert _best([lucky[0]], "rmse_speed_mps") == ", smallest rmse_speed_mps 0.300"
    assert _best([lucky[2]], "rmse_speed_mps") == ", FINISHED"


def free_port() -> int:
    with socket.socket() as smoke_check:
        smoke_check.bind(("127.0.0.1", 0))
        return int(smoke_check.getsockname()[1])


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Runs `python -m cfx ui --open` on a store with real runs; ends it as Ctrl-C would."""
    folder, port = tmp_path_factory.mktemp("ui"), free_port()
    store = f"sqlite:///{folder}/outputs/mlflow.db"
    abandoned = fill(store)
    stand_in, opened, said = folder / "browser", folder / "opened", folder / "said"
    stand_in.write_text(
        f'#!/bin/sh\necho "$1" > {opened}.part && mv {opened}.part {opened}\n', encoding="utf-8"
    )
    stand_in.chmod(0o755)
    environment = {
        **os.environ,
        "BROWSER": str(stand_in),
        "PYTHONPATH": str(Path(__file__).resolve().parent.parent),
    }
    environment.pop("MLFLOW_TRACKING_URI", None)
    with said.open("w") as output:
        command = [sys.executable, "-m", "cfx", "ui", "--port", str(port), "--open"]
        server = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT
        )
    try:
        wait_for(server, f"http://127.0.0.1:{port}/health", said)
        yield Served(store, said.read_text().splitlines(), opened, abandoned)
    finally:
        server.terminate()
        server.wait(60)


def wait_for(server: subprocess.Popen[bytes], address: str, said: Path) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end:
        assert server.poll() is None, said.read_text()
        try:
            with urllib.request.urlopen(address, timeout=5):  # noqa: S310 - this machine
                return
        except OSError:
            time.sleep(0.2)
    pytest.fail(f"no answer at {address}: {said.read_text()}")


def test_what_is_printed_is_short_and_runs_of_killed_processes_are_closed(served: Served) -> None:
    printed = [line for line in served.lines if line.startswith(("sweep", "job", "all jobs", "  "))]
    titles = [line.split(",")[0] for line in printed if not line.startswith(" ")]
    assert titles == [
        f"sweep {SWEEP}",
        "job killed",
        "job a single job",
        "all jobs of experiment cfx",
    ]
    assert printed[0].endswith(": 3 jobs, smallest rmse_speed_mps 0.346")
    assert len(printed) == 10
    assert any(line.startswith("job killed") and line.endswith(", KILLED") for line in printed)
    with quiet():
        from mlflow import MlflowClient

        run = MlflowClient(served.store).get_run(served.abandoned)
    assert (run.info.status, run.data.tags["cfx.failure"]) == (
        "KILLED",
        "the process ended without closing the run",
    )


def test_a_store_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["ui", "--uri", "outputs/mlflow.db"]) == 2
    assert capsys.readouterr().err.startswith(
        "--uri=outputs/mlflow.db: MLflow needs a database or a server; write sqlite:///"
    )


def test_the_first_page_opens_in_the_browser_when_asked(served: Served) -> None:
    end = time.monotonic() + 60
    while not served.opened.is_file() and time.monotonic() < end:
        time.sleep(0.1)
    assert served.opened.read_text().strip() == served.link("table", "sweep")


def test_a_browser_shows_the_sweeps_improvements_in_a_table_and_in_charts(
    served: Served, browser: Browser
) -> None:
    page = browser.page
    page.goto(served.link("table", "sweep"))
    results = page.locator("[role=gridcell][col-id='tags.`result`']")
    results.nth(2).wait_for()
    assert [text.split()[0] for text in results.all_inner_texts()] == ["+23.4%", "+12.3%", "-5.7%"]
    headings = page.locator("[role=columnheader]").all_inner_texts()
    shown = list(dict.fromkeys(text.strip() for text in headings))
    first = shown[shown.index("model") :][:4]
    assert first == ["model", "policy", "learner", "result"], "what it is, and how good, come first"
    names = page.locator("[role=gridcell][col-id='attributes.`Run Name`']").all_inner_texts()
    assert [name.split()[-1] for name in names] == ["w99-gru", "krauss-gru", "w74-gru"]
    page.goto(served.link("charts", "sweep"))
    page.get_by_text("rmse_speed_mps", exact=True).first.wait_for()
    # The first charts are the error and the improvement. Beside them only what differs.
    page.get_by_text("improvement_percent", exact=True).first.wait_for()
    page.locator("svg").get_by_text("0.35", exact=True).first.wait_for()
    page.get_by_text("model", exact=True).first.wait_for()
    assert page.get_by_text("seed", exact=True).count() == 0
    assert browser.over_network()
    assert browser.outside() == []


def test_a_browser_compares_a_sweeps_jobs_and_shows_all_jobs(
    served: Served, browser: Browser
) -> None:
    page = browser.page
    page.goto(served.link("compare", "sweep"))
    page.get_by_text("Comparing 3 Runs from 1 Experiment").wait_for()
    page.get_by_text("krauss-gru").first.wait_for()
    page.goto(served.link("table", "all jobs"))
    page.get_by_role("link", name="a single job").wait_for()
    names = page.locator("[role=gridcell][col-id='attributes.`Run Name`']").all_inner_texts()
    assert [name.split("\n")[-1] for name in names] == [
        "a single job",
        "w99-gru",
        "krauss-gru",
        "w74-gru",
        "killed",
    ]
    page.goto(served.link("page", "job a single"))
    page.get_by_text("rmse_speed_mps").first.wait_for()
    assert browser.outside() == []
