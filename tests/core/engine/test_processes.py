"""Workers of the engine `local` end with the job, and say how far they are."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from tests.scripts import ENVIRONMENT, command_of, run_script

_SCRIPT = """
import os, sys, time
from cfx.core.local_engine import in_processes

def work(shard, report):
    open(f"{shard}.{os.getpid()}", "w").close()
    for _ in range(100):
        report(1)
        time.sleep(0.1)

for _ in in_processes(work, [r"%s/a", r"%s/b"], lambda units: print(units, flush=True), 2):
    pass
"""


def _workers(folder: Path) -> list[int]:
    return [int(file.suffix[1:]) for file in folder.glob("[ab].*")]


def _is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_job(how: signal.Signals, tmp_path: Path) -> None:
    job = subprocess.Popen(
        command_of(_SCRIPT % (tmp_path, tmp_path), tmp_path),
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert job.stdout is not None
    assert job.stdout.readline() == "1\n", "progress is reported while work goes on"
    deadline = time.monotonic() + 60
    while len(_workers(tmp_path)) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    workers = _workers(tmp_path)
    assert len(workers) == 2
    os.kill(job.pid, how)
    job.communicate(timeout=60)
    while any(map(_is_running, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(_is_running, workers))


_SHARED = """
import os, time
from cfx.core.local_engine import in_processes

def work(shard, report):
    for _ in range(40):
        time.sleep(0.1)
        report(1)
    if shard == "broken":
        raise ValueError("broken")
    return os.getpid()

units = []
found = dict(in_processes(work, ["a", "b", "c"], units.append, 2))
assert sorted(found) == [0, 1, 2]
assert os.getpid() in found.values(), "this process works too"
assert len(set(found.values())) == 2
assert sum(units) == 120
try:
    # The worker takes the first shard.
    list(in_processes(work, ["broken", *"abcdefghij"], units.append, 2))
except ValueError as error:
    print(error)
"""


@pytest.mark.slow
def test_this_process_works_beside_the_workers_and_hears_of_their_errors(tmp_path: Path) -> None:
    ran = run_script(_SHARED, tmp_path)
    assert ran.stdout == "broken\n", ran.stderr
