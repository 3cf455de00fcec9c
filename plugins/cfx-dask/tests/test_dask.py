"""The engine `dask`: its settings, its own cluster, and what it says where there is none."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from cfx.core import registry
from cfx.core.distributions import install_line
from cfx.errors import ConfigError, EngineError, NotInstalledError
from cfx_dask.engine.engine import DaskEngine
from tests.shard_work import dies, only_on_good, slowly, where

from .clusters import Cluster, free_port


def nothing(_units: int) -> None:
    """Reports to nobody."""


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"address": "127.0.0.1"}, "tcp://HOST:PORT"),
        ({"address": "tcp://localhost"}, "tcp://HOST:PORT"),
        ({"address": "tcp://localhost:1", "cluster": "slurm"}, "give one of them"),
        ({"cluster": "moon"}, "slurm"),
        ({"workers": 0}, "greater than or equal to 1"),
        ({"patience_s": 0}, "greater than 0"),
    ],
)
def test_wrong_settings_are_said_before_any_work(
    settings: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        registry.create("engine", {"name": "dask", **settings})


@pytest.mark.parametrize(
    ("missing", "settings", "line"),
    [
        ("distributed", {}, "cfx-dask"),
        ("dask_jobqueue", {"cluster": "slurm"}, "cfx-dask"),
        ("dask_kubernetes", {"cluster": "kubernetes"}, "dask-kubernetes"),
    ],
)
def test_what_is_not_installed_is_said_with_the_line_that_installs_it(
    missing: str, settings: dict[str, object], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == missing else found(name)
    )
    with pytest.raises(NotInstalledError, match=re.escape(install_line(line))):
        DaskEngine(**settings)


@pytest.mark.slow
def test_making_it_imports_nothing_of_dask() -> None:
    script = (
        "import sys; from cfx.core import registry;"
        " registry.create('engine', {'name': 'dask'});"
        " sys.exit(str({'dask', 'distributed'} & set(sys.modules) or '') or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_scheduler_that_is_not_there_is_said_in_a_sentence() -> None:
    engine = DaskEngine(address=f"tcp://127.0.0.1:{free_port()}", patience_s=0.5)
    with pytest.raises(
        EngineError, match=r"no scheduler has answered .* what was finished is kept"
    ):
        list(engine.map(slowly, [(1, 0.0)], nothing))
    engine.close()


@pytest.fixture
def cluster() -> Cluster:
    made = Cluster()
    yield made
    made.stop()


@pytest.mark.slow
def test_a_scheduler_without_workers_is_said_in_a_sentence(cluster: Cluster) -> None:
    engine = DaskEngine(address=cluster.address, patience_s=8)
    with pytest.raises(EngineError, match=r"no worker for .* dask worker tcp"):
        list(engine.map(slowly, [(1, 0.0)], nothing))
    engine.close()


@pytest.mark.slow
def test_a_worker_with_a_full_disk_hands_its_shards_to_another(
    cluster: Cluster, tmp_path: Path
) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    disk = tmp_path / "disk"
    disk.mkdir()
    for number in range(12):
        (disk / f"{number}").symlink_to(full)  # writing there ends in ENOSPC
    cluster.start_worker(CFX_TEST_WORKER="full", CFX_TEST_DISK=str(disk))
    cluster.start_worker(CFX_TEST_WORKER="good")
    engine = DaskEngine(address=cluster.address)
    shards = [(number, disk) for number in range(12)]
    found = dict(engine.map(where, shards, nothing))
    engine.close()
    assert found == dict.fromkeys(range(12), "good")


@pytest.mark.slow
def test_a_worker_that_is_unfit_hands_its_shards_to_another(cluster: Cluster) -> None:
    cluster.start_worker(CFX_TEST_WORKER="bad")
    cluster.start_worker(CFX_TEST_WORKER="good")
    engine = DaskEngine(address=cluster.address)
    found = dict(engine.map(only_on_good, range(8), nothing))
    engine.close()
    assert found == dict.fromkeys(range(8), "good")


@pytest.mark.slow
def test_a_shard_that_kills_every_worker_is_given_up(cluster: Cluster) -> None:
    cluster.start_worker()
    engine = DaskEngine(address=cluster.address, retries=0)
    with pytest.raises(EngineError, match=r"given up after 1 tries .*memory"):
        list(engine.map(dies, [1], nothing))
    engine.close()


@pytest.mark.slow
def test_a_cluster_of_its_own_starts_works_and_ends() -> None:
    engine = DaskEngine(workers=1, memory="1GB")
    found = dict(engine.map(slowly, [(2, 0.0), (3, 0.0)], nothing))
    # Each message holds a shard: Dask would keep a thousand of them.
    streams = engine._connection._cluster.scheduler.stream_comms.values()
    assert {stream.recent_message_log.maxlen for stream in streams} == {1}
    places = listening()
    engine.close()
    assert found == {0: 4, 1: 9}
    assert places == {"127.0.0.1"}, "nobody outside this machine may reach a cluster of its own"


def listening() -> set[str]:
    """Returns the addresses at which this process and its children listen."""
    me = psutil.Process()
    found = set()
    for process in (me, *me.children(recursive=True)):
        for connection in process.net_connections(kind="inet"):
            if connection.status == psutil.CONN_LISTEN:
                found.add(connection.laddr.ip)
    return found
