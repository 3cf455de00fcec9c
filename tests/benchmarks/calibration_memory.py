"""Memory and CPU time of one calibration of I-80's drivers, from 4,096 candidates each, on one core.

`python -m tests.benchmarks.calibration_memory driver_specific --model krauss --copies 4`: `driver_specific`,
`pooled` (the pooled sets of six networks) or `labels`; `--copies` makes more drivers of the 229
that `../shared/data` has.
"""

from __future__ import annotations

import argparse
import resource
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.core.threads import limit_cores
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, Windows, WindowSettings

_FILE = Path(__file__).parents[3] / "shared" / "data" / "i80_reconstructed_pairs.parquet"
_NETWORKS = 6


def memory() -> float:
    """Returns what this process holds, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def drivers(copies: int) -> PairSet:
    """Returns I-80's pairs, each as often as that."""
    pairs = TidyDataset(path=str(_FILE), min_duration=30).load()
    several = []
    for copy in range(copies):
        for pair in pairs:
            several.append(replace(pair, pair_id=f"{pair.pair_id} {copy}"))
    return PairSet(tuple(several), pairs.source)


def calibrate(what: str, model: DrivingModel, pairs: PairSet, batch: PairBatch) -> None:
    """Runs one calibration, without a cache."""
    tool = Calibrator(
        Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0, memory=1 << 30),
        cache=Cache(None),
    )
    settings = WindowSettings()
    split = Split.of(pairs, settings, 0.8)
    if what == "driver_specific":
        tool.driver_specific(pairs, batch, split.frame)
    elif what == "pooled":
        number = torch.arange(_NETWORKS)[:, None]
        tool.pooled(pairs, batch, split.frame, torch.arange(len(pairs)) % _NETWORKS != number)
    else:
        fixed = model.space.defaults().expand(len(pairs), -1)
        tool.labels(pairs, batch, Windows.of(split.windows, settings), fixed)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["driver_specific", "pooled", "labels"])
    parser.add_argument("--model", default="krauss")
    parser.add_argument("--copies", type=int, default=1)
    options = parser.parse_args()
    limit_cores(1)
    torch.set_num_threads(1)
    imports = memory()
    pairs = drivers(options.copies)
    batch = PairBatch.of(pairs)
    recordings = memory()
    model = cast("DrivingModel", registry.create("model", {"name": options.model}))
    before = resource.getrusage(resource.RUSAGE_SELF)
    calibrate(options.what, model, pairs, batch)
    after = resource.getrusage(resource.RUSAGE_SELF)
    print(
        f"{options.what}, {options.model}, {len(pairs)} pairs:"
        f" {after.ru_utime - before.ru_utime:.2f} s,"
        f" {after.ru_stime - before.ru_stime:.2f} s of the system; MB: {imports:.0f} imports,"
        f" {recordings - imports:.0f} recordings, {after.ru_maxrss / 1024:.0f} at most"
    )


if __name__ == "__main__":
    main()
