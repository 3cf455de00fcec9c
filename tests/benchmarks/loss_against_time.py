"""The loss that each optimizer reaches within equal times, for driver-specific parameters and for labels.

`python -m tests.benchmarks.loss_against_time --model krauss`: each optimizer runs with one budget of
evaluations after the other, each from the start, on one core; the best mean loss of all runs that
took no longer than a time is what it reaches in that time. Times are CPU seconds. The drivers are I-80's, in
`../shared/data`. A run that is expected to take longer than the longest time is left out.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.optimizers import Optimizer
from cfx.calibration.rmse import SpeedRmse
from cfx.core import registry
from cfx.core.threads import limit_cores
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, WindowSettings

_FILE = Path(__file__).parents[3] / "shared" / "data" / "i80_reconstructed_pairs.parquet"
_SPLIT = 0.8
_TIMES_S = (0.1, 0.3, 1.0, 3.0, 10.0)
_BUDGETS: dict[str, tuple[dict[str, Any], ...]] = {
    "random": tuple({"samples": 2**k} for k in range(6, 21)),
    "gradient": tuple({"samples": 2**k} for k in range(6, 20)),
    "shade": tuple({"samples": 2**k} for k in range(12, 20)),
    "botorch": (
        {"screening": 256, "iterations": 0},
        {"iterations": 0},
        {"iterations": 2},
        {"iterations": 8},
        {"iterations": 30},
        {"iterations": 100},
    ),
    "cma": tuple({"samples": samples} for samples in (30, 100, 300, 1_000, 3_000, 10_000)),
    "differential_evolution": tuple(
        {"generations": count} for count in (1, 4, 14, 50, 150, 500, 1_500)
    ),
}
"""Settings of each optimizer, in the order of their cost."""

_STEEPEST = 6.0
"""Times the cost of one budget that the next one costs at most."""


def problems(model: DrivingModel, pairs: int) -> Iterator[tuple[str, SegmentLosses]]:
    """Yields the losses of full training parts and of their windows."""
    dataset = TidyDataset(path=str(_FILE), recording="i80-0400", min_duration=70, max_pairs=pairs)
    pair_set = dataset.load()
    batch, windows = PairBatch.of(pair_set), WindowSettings()
    split = Split.of(pair_set, windows, _SPLIT)
    stepper = MemoryStepper(model, batch.dt)
    whole = torch.arange(len(batch))
    yield (
        "fixed",
        SegmentLosses.of_segments(
            stepper, SpeedRmse(), batch, whole, torch.zeros_like(whole), split.frame
        ),
    )
    pair = whole.repeat_interleave(split.windows)
    number = torch.cat([torch.arange(count) for count in split.windows.tolist()])
    steps = torch.full_like(pair, windows.length)
    yield (
        "labels",
        SegmentLosses.of_segments(
            stepper, SpeedRmse(), batch, pair, number * windows.stride, steps
        ),
    )


def run(
    name: str, options: dict[str, Any], losses: SegmentLosses, guesses: Tensor
) -> tuple[float, float]:
    """Returns the CPU seconds and the mean loss of one run of an optimizer."""
    optimizer = cast("Optimizer", registry.create("optimizer", {"name": name, **options}))
    began = time.process_time()
    solution = optimizer.minimize(
        losses.for_work(optimizer.evaluations(guesses.shape[-1])),
        guesses,
        seed=0,
        objective_bytes=losses.bytes_per_candidate,
    )
    return time.process_time() - began, float(solution.loss.mean())


def curve(name: str, losses: SegmentLosses, guesses: Tensor) -> list[tuple[float, float]]:
    """Returns the seconds and the mean loss of each budget of an optimizer."""
    found: list[tuple[float, float]] = []
    for options in _BUDGETS[name]:
        if len(found) > 1 and _expected(found) > 1.2 * _TIMES_S[-1]:
            break
        seconds, loss = run(name, options, losses, guesses)
        found.append((seconds, loss))
        print(f"  {name} {options}: {seconds:.2f} s, {loss:.5f}", flush=True)
    return found


def _expected(found: list[tuple[float, float]]) -> float:
    """Returns how long the next run will take, judged by the last two."""
    (before, _), (last, _) = found[-2:]
    return last * min(_STEEPEST, max(1.0, last / max(before, 1e-3)))


def reached(found: list[tuple[float, float]], seconds: float) -> float:
    """Returns the best loss within a time; infinite where no run was short enough."""
    return min((loss for took, loss in found if took <= seconds), default=math.inf)


def main() -> None:
    """Measures and prints a table for each kind of problem."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="krauss")
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("--optimizers", nargs="*", default=list(_BUDGETS))
    options = parser.parse_args()
    limit_cores(1)
    torch.set_num_threads(1)
    model = cast("DrivingModel", registry.create("model", {"name": options.model}))
    for kind, losses in problems(model, options.pairs):
        default = model.space.to_unit(model.space.defaults())
        guesses = default.expand(losses.problems, 1, -1)
        print(f"{options.model}, {kind}: {losses.problems} problems", flush=True)
        run("random", {"samples": 4096}, losses, guesses)  # its kernel is compiled
        rows = {}
        for name in options.optimizers:
            rows[name] = curve(name, losses, guesses)
        print("| optimizer | " + " | ".join(f"{time:g} s" for time in _TIMES_S) + " |")
        print("| --- " * (1 + len(_TIMES_S)) + "|")
        for name, found in rows.items():
            best = [reached(found, seconds) for seconds in _TIMES_S]
            cells = ["" if math.isinf(loss) else f"{loss:.5f}" for loss in best]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
