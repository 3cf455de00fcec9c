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
import time
import tomllib
from pathlib import Path

import numpy as np
import psutil
import pytest

from cfx.errors import NotInstalledError, SumoError
from cfx.extras import install_line
from cfx.simulators.sumo import installed
from cfx.simulators.sumo.channel import Message
from cfx.simulators.sumo.session import Session

ROOT = Path(__file__).resolve().parents[2]

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)


def request(speed: float = 10.0) -> Message:
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
    return Message(
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


@needs_sumo
def test_processes_stay_and_end_with_the_session(scratch: Path) -> None:
    with Session(2) as session:
        assert session.processes == ()
        one = session.answer([request()])
        assert len(session.processes) == 1
        many = session.answer([request(speed) for speed in (10.0, 11.0, 12.0, 13.0)])
        processes = session.processes
        assert len(processes) == len(list(scratch.iterdir())) == 2
        assert [answer.arrays["speed"][0, 0] for answer in many] == pytest.approx(
            [10.26, 11.26, 12.26, 13.26]
        )
        assert np.array_equal(one[0].arrays["speed"], many[0].arrays["speed"])
    assert not any(psutil.pid_exists(process) for process in processes)
    assert not list(scratch.iterdir())


@needs_sumo
def test_a_process_that_dies_is_told_in_one_sentence_and_the_session_can_start_again(
    scratch: Path,
) -> None:
    with Session(1) as session:
        session.answer([request()])
        os.kill(session.processes[0], signal.SIGKILL)
        with pytest.raises(
            SumoError, match=r"^a SUMO process ended by itself \(signal SIGKILL\); run again"
        ):
            session.answer([request()])
        assert session.processes == ()
        assert len(session.answer([request()])) == 1
    assert not list(scratch.iterdir())


@needs_sumo
def test_nothing_is_left_when_the_job_is_killed() -> None:
    script = textwrap.dedent("""
        import time
        from tests.simulators.test_sumo_session import request
        from cfx.simulators.sumo.session import Session
        session = Session(1)
        session.answer([request()])
        print(session.processes[0], session._started[0]._folder.name, flush=True)
        time.sleep(60)
    """)
    job = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert job.stdout is not None
    process, folder = job.stdout.readline().split()
    assert psutil.pid_exists(int(process))
    job.kill()
    job.wait()
    job.stdout.close()
    assert wait_until(lambda: not psutil.pid_exists(int(process))), (
        "the SUMO process outlives the job"
    )
    assert wait_until(lambda: not Path(folder).exists()), "its folder stays"


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
        f" {install_line('cfx-driving[sumo]')}"
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
def test_versions_that_the_extra_allows_are_welcome(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    assert installed.require_sumo() == version


def test_the_extra_asks_for_the_versions_that_are_checked() -> None:
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]["sumo"]
    oldest, below = installed.OLDEST, installed.BELOW
    assert any(one.startswith(f"libsumo>={oldest[0]}.{oldest[1]},<{below[0]}") for one in extra)
