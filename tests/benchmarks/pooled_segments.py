"""Which length of segments serves pooled parameters best on drivers they are not calibrated on.

`python -m tests.benchmarks.pooled_segments idm gipps`: each recording of `../shared/data` is left
out in turn. Parameters are pooled over up to 25 pairs of each other one, all of which count alike,
and tested on whole trajectories of the one left out.

`--split FILE` takes the pairs of a published split of I-80 instead: its `manifest.csv`, with columns
`run`, `follower`, `leader` and `split` (train or test). Pairs that the recording lacks are counted.

Errors are means over pairs of the RMSE of speed (m/s) and of the gap (m).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.losses import PooledLosses, TrajectorySegments
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import Optimizer
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.core.threads import limit_cores
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper

_DATA = Path(__file__).parents[3] / "shared" / "data"
_I80 = "i80_reconstructed_pairs"
_ROADS = (
    _I80,
    "ngsim_i80_hov_ramp_pairs",
    "tgsim_freeway_pairs",
    "openacc_zalazone_pairs",
    "openacc_vicolungo_pairs",
    "openacc_ispra_low_speed_pairs",
    "carma_platoon_pairs",
)
_PAIRS_OF_ROAD = 25
_MEMORY = 1 << 30
_WEAK = 0.01
"""The weight of the weak prior."""


class Task(NamedTuple):
    """What to calibrate on, and what to test on.

    Attributes:
        name: in the table.
        batch: P pairs.
        weight: how much each pair counts, `(P,)`.
        tested: `(P,)` bool.
    """

    name: str
    batch: PairBatch
    weight: Tensor
    tested: Tensor


def roads() -> Iterator[Task]:
    """Yields the tasks of leaving out each road."""
    pairs, road = [], []
    for number, name in enumerate(_ROADS):
        loaded = TidyDataset(path=str(_DATA / f"{name}.parquet"), min_duration=30).load()
        chosen = list(loaded)[:: -(-len(loaded) // _PAIRS_OF_ROAD)]
        pairs += chosen
        road += [number] * len(chosen)
    batch, of_pair = PairBatch.of(PairSet(tuple(pairs), "roads")), torch.tensor(road)
    weight = 1.0 / torch.bincount(of_pair).double()[of_pair]
    for number, name in enumerate(_ROADS):
        yield Task(name.removesuffix("_pairs"), batch, weight, of_pair == number)


def published(manifest: Path) -> Iterator[Task]:
    """Yields the task of a published split of I-80."""
    table = pd.read_csv(manifest)
    recording = "i80-" + table["run"].str.extract(r"(\d{4})pm-")[0]
    ids = recording + "-" + table["follower"].astype(str) + "-" + table["leader"].astype(str)
    split = dict(zip(ids, table["split"], strict=True))
    loaded = TidyDataset(path=str(_DATA / f"{_I80}.parquet")).load()
    pairs = [pair for pair in loaded if pair.pair_id in split]
    tested = torch.tensor([split[pair.pair_id] == "test" for pair in pairs])
    print(
        f"{int((~tested).sum())} of {sum(table['split'] == 'train')} pairs to calibrate on,"
        f" {int(tested.sum())} of {sum(table['split'] == 'test')} to test on"
    )
    batch = PairBatch.of(PairSet(tuple(pairs), "published split"))
    yield Task("published split", batch, torch.ones(len(pairs), dtype=torch.float64), tested)


def pooled(
    task: Task, stepper: MemoryStepper, objective: Objective, seconds: float | None
) -> Tensor:
    """Returns parameters `(1, n)` in unit space, pooled over the pairs that are not tested."""
    length = None if seconds is None else round(seconds / task.batch.dt)
    segments = TrajectorySegments.of_pairs(
        stepper, objective, task.batch, task.batch.lengths - 1, length
    )
    weight = segments.weight * task.weight[segments.pair]
    losses = PooledLosses(segments, ~task.tested[segments.pair][None], _MEMORY, weight)
    optimizer = cast("Optimizer", registry.create("optimizer", {"name": "shade"}))
    solver = Solver(stepper, optimizer, 0, objective=objective, prior=_WEAK).of_pooled
    row = solver.minimize(losses, lambda _: None)
    return solver.space.to_unit(torch.as_tensor(row["parameters"])).double()


def errors(task: Task, stepper: MemoryStepper, unit: Tensor) -> list[float]:
    """Returns the mean RMSE of speed and of the gap over whole trajectories that are tested."""
    tested = task.tested.nonzero()[:, 0]
    means = []
    for name in ("speed_rmse", "gap_rmse"):
        objective = cast("Objective", registry.create("objective", {"name": name}))
        whole = TrajectorySegments.of_pairs(stepper, objective, task.batch, task.batch.lengths - 1)
        losses = whole.take(tested)(unit.expand(len(tested), 1, -1))
        means.append(float(losses.mean()))
    return means


def print_table(
    tasks: Sequence[Task], model: str, objective: str, lengths: Sequence[float | None]
) -> None:
    """Prints a row for each length: errors by task, their geometric means, and CPU seconds."""
    driven = cast("DrivingModel", registry.create("model", {"name": model}))
    minimised = cast("Objective", registry.create("objective", {"name": objective}))
    for seconds in lengths:
        began, found = time.process_time(), []
        for task in tasks:
            stepper = MemoryStepper(driven, task.batch.dt, compile="always")
            found.append(errors(task, stepper, pooled(task, stepper, minimised, seconds)))
        took = time.process_time() - began
        cells = [f"{speed:.3f}, {gap:.2f}" for speed, gap in found]
        mean = np.exp(np.log(found).mean(axis=0))
        name = "whole" if seconds is None else f"{seconds:g} s"
        row = [model, objective, name, *cells, f"{mean[0]:.3f}, {mean[1]:.2f}", f"{took:.1f} s"]
        print("| " + " | ".join(row) + " |", flush=True)


def main() -> None:
    """Measures and prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--objectives", nargs="*", default=["speed_rmse", "gap_rmse"])
    parser.add_argument("--lengths", nargs="*", type=float, default=[5, 10, 20, 40])
    parser.add_argument("--split", type=Path)
    options: Any = parser.parse_args()
    limit_cores(1)
    torch.set_num_threads(1)
    tasks = list(roads() if options.split is None else published(options.split))
    columns = ["model", "objective", "length", *(task.name for task in tasks), "all", "CPU"]
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|")
    for model in options.models:
        for objective in options.objectives:
            print_table(tasks, model, objective, [None, *options.lengths])


if __name__ == "__main__":
    main()
