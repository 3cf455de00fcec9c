"""How far calibrations end above what SciPy's differential evolution finds, and how long they take.

`python -m tests.benchmarks.optimum krauss idm gipps w99 --reference outputs/optimum.json`: whole
trajectories of 20 I-80 and 5 OpenACC drivers in `../shared/data`, without a prior, one core. The
reference is the better of two runs of `scipy.optimize.differential_evolution` for each driver, of
up to 1,200 generations; it takes minutes for Wiedemann's models and is kept in a file.

With `--plain` (IDM, Gipps, Wiedemann 99; errors of speed) the losses of the reference come from the
loops of `numba_loops`, which share no code with cfx, and `--drivers 5` takes the first drivers of
I-80 alone.

Of each optimizer: the mean excess over the reference in percent (the median, lowest and highest,
and with `--seeds` the lowest and highest mean of one seed); for how many drivers it is above 0.1 %;
for how many independent ends differ by more than 1 %; CPU seconds for each driver.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import differential_evolution
from torch import Tensor

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import Optimizer, Solution
from cfx.calibration.settings import APART
from cfx.core import registry
from cfx.core.threads import limit_cores
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper

_DATA = Path(__file__).parents[3] / "shared" / "data"
_RECORDINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("i80_reconstructed_pairs", {"min_duration": 70, "max_pairs": 20}),
    ("openacc_zalazone_pairs", {"min_duration": 100, "max_pairs": 3}),
    ("openacc_vicolungo_pairs", {"min_duration": 100, "max_pairs": 2}),
)
_OBJECTIVES = "gap_rmse", "speed_rmse"
_RUNS = (("best1bin", 15), ("currenttobest1bin", 20))
"""Strategies and sizes of SciPy's populations, in multiples of the number of parameters."""

_OFF = 0.001
"""Share of the reference's loss by which an optimum counts as missed."""


def losses_of(model: str, objective: str, batch: PairBatch) -> SegmentLosses:
    """Returns the losses of whole trajectories, compiled whatever the work."""
    driven = cast("DrivingModel", registry.create("model", {"name": model}))
    minimised = cast("Objective", registry.create("objective", {"name": objective}))
    stepper = MemoryStepper(driven, batch.dt, compile="always")
    pair = torch.arange(len(batch))
    return SegmentLosses.of_segments(
        stepper, minimised, batch, pair, torch.zeros_like(pair), batch.lengths - 1
    )


def plain(losses: SegmentLosses, model: str) -> Callable[[Tensor], Tensor]:
    """Returns the errors of speed of one driver's candidates `(1, q, n)`, by a loop in numba."""
    from tests.benchmarks import numba_loops

    segments, space = losses.segments, losses.stepper.model.space
    frames = [segments.leader_position, segments.leader_speed, segments.leader_acceleration]
    arrays = [np.ascontiguousarray(one.numpy().T) for one in frames]
    for value in (
        segments.leader_length,
        segments.position,
        segments.speed,
        segments.acceleration,
    ):
        arrays.append(value.numpy())
    arrays.append(np.ascontiguousarray(segments.measured_speed.numpy().T))
    steps = segments.counted.sum(0).long().numpy()
    loop = numba_loops.LOOPS[model]

    def errors(unit: Tensor) -> Tensor:
        columns = []
        for value in space.unpack(space.from_unit(unit[0])).values():
            columns.append(value.expand(unit.shape[1]).numpy())
        candidates = np.ascontiguousarray(np.stack(columns, axis=1))
        return torch.from_numpy(loop(*arrays, steps, candidates, losses.stepper.dt))

    return errors


def reference(losses: SegmentLosses, model: str | None = None) -> list[float]:
    """Returns the lowest loss that SciPy's differential evolution finds for each driver.

    Args:
        losses: of cfx.
        model: its name, where the loop of `plain` takes the place of cfx's losses.
    """
    n = len(losses.stepper.model.space)
    lowest = []
    for number in range(losses.problems):
        of_driver: Callable[[Tensor], Tensor] = losses.take(slice(number, number + 1))
        if model is not None:
            of_driver = plain(losses.take(slice(number, number + 1)), model)

        def loss(
            candidates: NDArray[np.float64], of_driver: Callable[[Tensor], Tensor] = of_driver
        ) -> Any:
            unit = torch.from_numpy(np.ascontiguousarray(candidates.T))[None]
            return np.nan_to_num(of_driver(unit)[0].numpy(), nan=1e100, posinf=1e100)

        found = []
        for seed, (strategy, size) in enumerate(_RUNS):
            solution = differential_evolution(
                loss,
                [(0.0, 1.0)] * n,
                rng=np.random.default_rng(seed),
                strategy=strategy,
                popsize=size,
                maxiter=1200,
                tol=1e-7,
                atol=1e-9,
                polish=False,
                vectorized=True,
                updating="deferred",
            )
            found.append(float(solution.fun))
        lowest.append(min(found))
    return lowest


def minimized(name: str, losses: SegmentLosses, seed: int) -> tuple[Solution, float]:
    """Returns what an optimizer of cfx finds from the default on, and its CPU seconds."""
    usual = cast("Optimizer", registry.create("optimizer", {"name": name}))
    model, space = losses.stepper.model, losses.stepper.model.space
    optimizer = usual.with_effort(model.search_effort, len(space))
    default: Tensor = space.to_unit(space.defaults()).double()
    began = time.process_time()
    solution = optimizer.minimize(losses, default.expand(losses.problems, 1, -1), seed=seed)
    return solution, time.process_time() - began


def cell(
    name: str, losses_of_batches: Sequence[SegmentLosses], lowest: Sequence[float], seeds: int
) -> str:
    """Returns how far an optimizer ends above the reference, for how many drivers, and its time."""
    excess, seconds, doubted = [], 0.0, 0
    for losses in losses_of_batches:
        minimized(name, losses.take(slice(0, 1)), 0)  # its kernels are compiled
    for seed in range(seeds):
        found = []
        for losses in losses_of_batches:
            solution, took = minimized(name, losses, seed)
            found.append(solution)
            seconds += took
        whole = Solution.joined(found)
        excess.append(whole.loss.numpy() / np.asarray(lowest) - 1)
        doubted += int((whole.apart > APART).sum())
    over = np.stack(excess)
    of_seeds = ""
    if seeds > 1:
        means = 100 * over.mean(axis=1)
        of_seeds = f"; means of seeds {means.min():.2f} to {means.max():.2f}"
    return (
        f"{100 * over.mean():.2f} ({100 * np.median(over):.2f}, {100 * over.min():.0f} to"
        f" {100 * over.max():.0f}){of_seeds}; {int((over > _OFF).sum())} of {over.size}; {doubted};"
        f" {seconds / over.size:.3f} s"
    )


def main() -> None:
    """Measures and prints a row for each model and objective."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--optimizers", nargs="*", default=["gradient", "shade"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--drivers", type=int, help="the first of I-80 alone")
    parser.add_argument("--reference", type=Path, required=True, help="made where it is missing")
    options = parser.parse_args()
    limit_cores(1)
    torch.set_num_threads(1)
    batches = []
    for name, chosen in _RECORDINGS:
        dataset = TidyDataset(path=str(_DATA / f"{name}.parquet"), **chosen)
        batches.append(PairBatch.of(dataset.load()))
    if options.drivers is not None:
        batches = [batches[0][: options.drivers]]
    known: dict[str, list[float]] = {}
    if options.reference.exists():
        known = json.loads(options.reference.read_text())
    columns = ["model", "objective", "reference", *options.optimizers]
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|")
    for model in options.models:
        for objective in ("speed_rmse",) if options.plain else _OBJECTIVES:
            losses = [losses_of(model, objective, batch) for batch in batches]
            key = f"{model} {objective}"
            if key not in known:
                loop = model if options.plain else None
                known[key] = [value for one in losses for value in reference(one, loop)]
                options.reference.write_text(json.dumps(known))
            cells = [model, objective, f"{np.mean(known[key]):.4f}"]
            for name in options.optimizers:
                cells.append(cell(name, losses, known[key], options.seeds))
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
