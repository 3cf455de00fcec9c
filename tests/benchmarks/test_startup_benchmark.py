"""How long the program takes to say its first word, to refuse what is wrong, and to answer.

Goals on an idle machine: the first line of a job after 0.5 s; a wrong path, a wrong column and what
is not installed after 1.5 s; `debug=quick` after 6 s; `plugins show` after 1.5 s; Tab after 0.5 s.
Each case runs once before, so that files are in the system's memory and kernels are compiled.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

_MISTAKE = 2


@pytest.fixture
def run(benchmark: Any, tmp_path: Path) -> Callable[..., int]:
    """Returns what times the program, five times, in one folder."""

    def times(*arguments: str, **variables: str) -> int:
        command = [sys.executable, "-m", "cfx", *arguments]
        environment = {**os.environ, **variables}

        def start() -> int:
            return subprocess.run(
                command, cwd=tmp_path, env=environment, capture_output=True, check=False
            ).returncode

        return int(benchmark.pedantic(start, rounds=5, warmup_rounds=1))

    return times


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], 0),
        (["plugins"], 0),
        (["plugins", "show", "model", "krauss"], 0),
        (["modle=w99"], _MISTAKE),
        (["data=tidy", "data.path=nowhere.parquet"], _MISTAKE),
        (["debug=quick"], 0),
    ],
    ids=["help", "plugins", "plugins show", "wrong option", "wrong path", "debug=quick"],
)
def test_an_answer(run: Callable[..., int], arguments: list[str], code: int) -> None:
    assert run(*arguments) == code


def test_a_wrong_column(run: Callable[..., int], tmp_path: Path) -> None:
    pd.DataFrame({"time": [0.0, 0.1], "speed": [1.0, 2.0]}).to_csv(tmp_path / "file.csv")
    assert run("data=tidy", "data.path=file.csv") == _MISTAKE


def test_what_is_not_installed(run: Callable[..., int]) -> None:
    if importlib.util.find_spec("dask_kubernetes") is not None:
        pytest.skip("dask-kubernetes is installed")
    assert run("engine=dask", "engine.cluster=kubernetes", "debug=quick") == _MISTAKE


@pytest.mark.parametrize("line", ["cfx plugins show model ", "cfx model="], ids=["own", "hydra"])
def test_tab(run: Callable[..., int], line: str) -> None:
    assert run("-sc", "query=bash", COMP_LINE=line, COMP_POINT=str(len(line))) == 0


def test_the_first_line_of_a_job(benchmark: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cfx", "debug=quick"]

    def first_line() -> bytes:
        job = subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert job.stdout is not None
        line = job.stdout.readline()
        jobs.append(job)
        return line

    def end() -> None:
        while jobs:
            job = jobs.pop()
            job.send_signal(signal.SIGTERM)
            job.communicate()

    jobs: list[subprocess.Popen[bytes]] = []
    line = benchmark.pedantic(first_line, setup=end, rounds=5, warmup_rounds=1)
    end()
    assert b"starting" in line
