"""A calibration on a cluster whose parts die ends with the same numbers as on this machine."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.core.engine import Engine
from cfx.core.local_engine import LocalEngine
from cfx.core.progress import Task
from cfx.data.pairs import PairBatch
from cfx.errors import EngineError
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Windows, WindowSettings
from cfx_dask.engine.engine import DaskEngine
from tests.drives import wavy_pairs

from .clusters import Cluster, meanwhile, running_cluster, until

SAMPLES = 12288
PAIRS, WINDOWS = 60, 240
"""Some fifteen groups of windows, each of some seconds on one core."""


class Counted(Task):
    """Remembers how much was done."""

    last: Task

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)  # type: ignore[arg-type]  # as they come
        Counted.last = self


def calibrated(engine: Engine, folder: Path | None) -> Tensor:
    """Returns the labels of made-up drivers."""
    model = W99()
    truth = model.space.defaults().expand(PAIRS, -1).clone()
    truth[:, 1] += torch.linspace(0, 0.5, PAIRS, dtype=torch.float64)
    pairs = wavy_pairs(model, truth, frames=5 * WINDOWS + 10)
    calibrator = Calibrator(
        Solver(MemoryStepper(model, 0.1), RandomSearch(samples=SAMPLES), seed=0, memory=1 << 28),
        cache=Cache(folder),
        progress=Counted,
        engine=engine,
    )
    windows = Windows.of(torch.full((len(pairs),), WINDOWS), WindowSettings())
    labels = calibrator.labels(pairs, PairBatch.of(pairs), windows, truth)
    assert Counted.last.done == Counted.last.total
    return torch.cat([labels.parameters, labels.loss[:, None]], dim=1)


@pytest.fixture(scope="module")
def expected() -> Tensor:
    return calibrated(LocalEngine(), None)


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    with running_cluster(workers=2) as made:
        yield made


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_workers_that_are_killed_ten_times_change_nothing(
    cluster: Cluster, expected: Tensor, tmp_path: Path
) -> None:
    seen = [0]

    def some_are_finished() -> bool:
        """Says whether results have come since the last kill: others are being worked on."""
        before, seen[0] = seen[0], len(list(tmp_path.rglob("*.entry")))
        return seen[0] > before

    engine = DaskEngine(address=cluster.address)
    with cluster.kills(5, some_are_finished):
        found = calibrated(engine, tmp_path)
    engine.close()
    assert torch.equal(found, expected)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_scheduler_that_is_started_again_changes_nothing(
    cluster: Cluster, expected: Tensor, tmp_path: Path
) -> None:
    def restart() -> None:
        until(lambda: any(tmp_path.rglob("*.entry")))
        cluster.scheduler.kill()
        cluster.scheduler.wait()
        time.sleep(2.0)
        cluster.scheduler = cluster.start_scheduler()
        cluster.start_worker()  # a worker ends with its scheduler
        cluster.start_worker()

    engine = DaskEngine(address=cluster.address)
    with meanwhile(restart):
        found = calibrated(engine, tmp_path)
    engine.close()
    assert torch.equal(found, expected)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("whose", ["scheduler", "worker"])
def test_a_network_that_is_gone_for_20_s_changes_nothing(
    cluster: Cluster, expected: Tensor, tmp_path: Path, whose: str
) -> None:
    """A stopped process answers nobody."""

    def pause() -> None:
        until(lambda: any(tmp_path.rglob("*.entry")))
        paused = [cluster.scheduler.pid]
        if whose == "worker":
            paused = cluster.children(cluster.workers[0])
        for process in paused:
            os.kill(process, signal.SIGSTOP)
        time.sleep(20.0)
        for process in paused:
            os.kill(process, signal.SIGCONT)

    engine = DaskEngine(address=cluster.address)
    with meanwhile(pause):
        found = calibrated(engine, tmp_path)
    engine.close()
    assert torch.equal(found, expected)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_was_finished_before_the_cluster_went_is_not_done_again(
    cluster: Cluster, expected: Tensor, tmp_path: Path
) -> None:
    def stop() -> None:
        until(lambda: any(tmp_path.rglob("*.entry")))
        cluster.stop()

    engine = DaskEngine(address=cluster.address, patience_s=3)
    with meanwhile(stop), pytest.raises(EngineError, match="what was finished is kept"):
        calibrated(engine, tmp_path)
    engine.close()
    before = len(list(tmp_path.rglob("*.entry")))
    assert before > 0
    assert torch.equal(calibrated(LocalEngine(), tmp_path), expected)
