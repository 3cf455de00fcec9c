"""SUMO's processes: how they start and end, and what is said where SUMO is not as it should be."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest

from cfx.core.distributions import install_line
from cfx.errors import NotInstalledError, SumoError
from cfx_sumo import installed
from cfx_sumo.simulation.session import Session
from cfx_sumo.simulation.worker import Answer, Request

ROOT = Path(__file__).resolve().parents[1]

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)


def request(speed: float = 10.0) -> Request:
    """One follower behind one leader for two steps."""
    header = {
        "dt": 0.1,
        "seed": 1,
        "car_follow_model": "Krauss",
        "constants": {"sigma": "0"},
        "names": [],
    }
    header |= {"leader_constants": {"maxSpeed": "130"}, "leader_names": []}
    still = np.full((2, 1), speed)
    arrays = {
        "attributes": np.empty((1, 0)),
        "leader_attributes": np.empty((1, 0)),
        "start": np.array([[0.0], [speed], [0.0]]),
    }
    return Request(
        header,
        arrays
        | {
            "leader_position": 90.0 + 0.1 * still,
            "leader_speed": still,
            "leader_acceleration": 0 * still,
        },
    )


def wait_until(done: object) -> bool:
    for _ in range(100):
        if done():  # type: ignore[operator]
            return True
        time.sleep(0.1)
    return False


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that this test's temporary folders lie in."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def processes(folder: Path) -> set[int]:
    """The SUMO processes that have their folder in a temporary folder."""
    return {int(own.name) for own in folder.glob("cfx-sumo-*/*")}


def speed_after(answer: Answer) -> float:
    """The speed after the first step; `request` has followers accelerate by 2.6 m/s2."""
    return float(answer.speed[0, 0])


@needs_sumo
def test_processes_stay_and_end_with_the_session(scratch: Path) -> None:
    with Session(2) as session:
        assert not list(scratch.iterdir())
        one = session.answer([request()])
        started = processes(scratch)
        many = session.answer([request(speed) for speed in (10.0, 11.0, 12.0, 13.0)])
        assert started <= processes(scratch)
        started = processes(scratch)
        assert len(started) <= 2  # one, where it has answered before the other is there
        assert [speed_after(answer) for answer in many] == pytest.approx(
            [10.26, 11.26, 12.26, 13.26]
        )
        assert np.array_equal(one[0].speed, many[0].speed)
    assert not any(psutil.pid_exists(process) for process in started)
    assert not list(scratch.iterdir())


@needs_sumo
@pytest.mark.parametrize("workers", [1, 3])
def test_every_thread_gets_the_answers_to_its_own_questions(workers: int) -> None:
    """Threads come at once, before any process runs, and each asks again and again."""
    ready = threading.Barrier(8)
    speeds = np.arange(8.0, 16.0)

    def ask(first: float) -> list[float]:
        ready.wait()
        found = []
        for k in range(4):
            asked = [request(first + 0.01 * k), request(first + 0.01 * k + 0.005)]
            found += [speed_after(answer) for answer in session.answer(asked)]
        return found

    with Session(workers) as session, ThreadPoolExecutor(len(speeds)) as pool:
        found = np.array(list(pool.map(ask, speeds)))
    expected = speeds[:, None] + 0.005 * np.arange(8) + 0.26
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@needs_sumo
def test_closing_ends_what_other_threads_wait_for(scratch: Path) -> None:
    with Session(2) as session, ThreadPoolExecutor(3) as pool:
        waiting = [pool.submit(session.answer, [request()] * 2000) for _ in range(3)]
        assert wait_until(lambda: len(processes(scratch)) == 2)
        session.close()
        for answers in waiting:
            with pytest.raises(SumoError, match=r"^SUMO was ended in the middle of a simulation$"):
                answers.result(timeout=60)
        assert not processes(scratch)


@needs_sumo
def test_a_refused_question_stops_no_other(scratch: Path) -> None:
    bad = request()
    bad.header["constants"] = {"tau": "-1"}
    with Session(1) as session, ThreadPoolExecutor(2) as pool:
        good = pool.submit(session.answer, [request()] * 20)
        with pytest.raises(SumoError, match=r"^SUMO refuses the vehicles: "):
            session.answer([request(), bad, request()])
        assert len(good.result()) == 20
        assert len(session.answer([request()])) == 1


@needs_sumo
def test_a_process_that_dies_is_told_in_one_sentence_and_the_session_can_start_again(
    scratch: Path,
) -> None:
    with Session(1) as session:
        session.answer([request()])
        (process,) = processes(scratch)
        os.kill(process, signal.SIGKILL)
        with pytest.raises(
            SumoError, match=r"^a SUMO process ended by itself \(SIGKILL\(-9\)\); run again"
        ):
            session.answer([request()])
        assert not processes(scratch)
        assert len(session.answer([request()])) == 1
    assert not list(scratch.iterdir())


@needs_sumo
def test_nothing_is_left_when_the_job_is_killed(tmp_path: Path) -> None:
    script = textwrap.dedent("""
        import time
        from test_session import request
        from cfx_sumo.simulation.session import Session
        session = Session(1)
        session.answer([request()])
        print("answered", flush=True)
        time.sleep(60)
    """)
    job = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert job.stdout is not None
    assert job.stdout.readline() == "answered\n"
    (process,) = processes(tmp_path)
    job.kill()
    job.wait()
    job.stdout.close()
    assert wait_until(lambda: not psutil.pid_exists(process)), "the SUMO process outlives the job"
    assert wait_until(lambda: not list(tmp_path.glob("cfx-sumo-*"))), "its folder stays"


@needs_sumo
@pytest.mark.parametrize(
    ("position", "leader"), [(0.0, 2e6), (999_893.0, 0.0)], ids=["starts beyond", "drives beyond"]
)
def test_a_vehicle_beyond_the_roads_end_is_no_result(position: float, leader: float) -> None:
    far = request(50.0)
    far.arrays["start"][0] = position
    far.arrays["leader_position"][:] = leader
    with (
        Session(1) as session,
        pytest.raises(
            SumoError, match=r"^SUMO lost a vehicle .*: it left the 1000 km of its road;"
        ),
    ):
        session.answer([far])


def test_a_missing_sumo_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(NotInstalledError) as error:
        Session(1)
    assert str(error.value) == (
        "SUMO is not installed; SUMO 1.28 or newer, below 2, comes with:"
        f" {install_line('cfx-sumo')}"
    )


@pytest.mark.parametrize("version", ["1.27.0", "2.0.0", "0.32.0", "nightly"])
def test_another_version_says_which_is_needed(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    with pytest.raises(
        SumoError,
        match=rf"^SUMO {version} is installed .* cfx works with SUMO 1\.28 or newer, below 2:",
    ):
        installed.require_sumo()


@pytest.mark.parametrize("version", ["1.28.0", "1.29.1", "1.30"])
def test_versions_that_the_distribution_allows_are_welcome(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    assert installed.require_sumo() == version


def test_the_distribution_asks_for_the_versions_that_are_checked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    oldest, below = installed.OLDEST, installed.BELOW
    assert f"libsumo>={oldest[0]}.{oldest[1]},<{below[0]}" in project["dependencies"]
