"""What a cluster costs: milliseconds for each shard, and the share of two cores that is used.

Run alone: `make bench`, or with pytest's `-k engine`. Other work on the machine makes both worse.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import torch

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.core import threads
from cfx.core.engine import Engine
from cfx.core.local_engine import LocalEngine
from cfx.data.pairs import PairBatch
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Windows, WindowSettings
from cfx_dask.engine.engine import DaskEngine
from tests.drives import wavy_pairs
from tests.shard_work import slowly

SHARDS = 200
DRIVERS = 192


def nothing(_units: int) -> None:
    """Reports to nobody."""


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = DaskEngine(workers=2)
    list(made.map(slowly, [(0, 0.0)] * 4, nothing))
    yield made
    made.close()


def test_overhead_of_a_shard(benchmark, engine: Engine) -> None:
    """Shards that do nothing: all of it is overhead."""

    def work() -> None:
        assert len(list(engine.map(slowly, [(1, 0.0)] * SHARDS, nothing))) == SHARDS

    benchmark.pedantic(work, rounds=3)
    benchmark.extra_info["ms per shard"] = 1000 * benchmark.stats["min"] / SHARDS


@pytest.mark.timeout(1200)
@threads.one_thread()
@threads.one_core()
def test_efficiency_of_two_workers(benchmark, engine: Engine) -> None:
    """Labels of some drivers with W99, in 45 shards: one core here against two workers."""
    model = W99()
    truth = model.space.defaults().expand(DRIVERS, -1).clone()
    truth[:, 1] += torch.linspace(0, 0.5, DRIVERS, dtype=torch.float64)
    pairs = wavy_pairs(model, truth, frames=1210)
    batch = PairBatch.of(pairs)
    windows = Windows.of(torch.full((len(pairs),), 240), WindowSettings())

    def seconds(where: Engine) -> float:
        calibrator = Calibrator(
            Solver(MemoryStepper(model, 0.1), RandomSearch(samples=8192), seed=0, memory=1 << 28),
            cache=Cache(None),
            engine=where,
        )
        began = time.perf_counter()
        calibrator.labels(pairs, batch, windows, truth)
        return time.perf_counter() - began

    seconds(engine)  # kernels are compiled, or read from the disk
    seconds(LocalEngine())
    # In turns, and the fastest of each: other work on the machine only slows down.
    times: list[float] = []

    def take_turns() -> None:
        times.append(seconds(LocalEngine()))

    benchmark.pedantic(seconds, args=(engine,), setup=take_turns, rounds=3)
    alone, together = min(times), benchmark.stats["min"]
    benchmark.extra_info["s alone"] = alone
    benchmark.extra_info["efficiency"] = alone / (2 * together)
    print(f"alone {alone:.1f} s, together {together:.1f} s, {alone / (2 * together):.3f} of ideal")
