"""What docs/how-to/uncertainty.md says of `calibration.posterior`: coverage, ranks, I-80, time.

python -m tests.benchmarks.posteriors coverage
python -m tests.benchmarks.posteriors recording
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Literal

import torch
from scipy.stats import chisquare

from cfx.calibration.optimizers.random import RandomSearch
from cfx.calibration.posterior.importance import sample
from cfx.calibration.posterior.intervals import parameter_intervals
from cfx.calibration.posterior.laplace import laplace, likely_starts
from cfx.calibration.posterior.levels import DETERMINED
from cfx.calibration.settings import CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from tests.calibration.posterior.recordings import draw_recordings

I80 = "../shared/data/i80_reconstructed_pairs.parquet"
SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)
CLASSES = 10


MODELS: dict[str, DrivingModel] = {"krauss": Krauss(), "idm": IDM(), "w99": W99()}
DRIVERS = {"krauss": 200, "idm": 200, "w99": 60}


def coverage(name: str) -> Iterator[str]:
    """Yields coverage of 90 % intervals and ranks of the truth, of synthetic drivers of 60 s."""
    model, drivers = MODELS[name], DRIVERS[name]
    signals: tuple[Literal["speed", "gap"], ...] = ("speed", "gap")
    for signal in signals:
        drawn = draw_recordings(model, drivers, signal=signal, seed=11)
        started = time.process_time()
        normal = laplace(drawn.posterior, likely_starts(drawn.posterior, seed=0))
        found = sample(drawn.posterior, normal, SHARES, seed=0, memory=1 << 30)
        seconds = time.process_time() - started
        n = len(drawn.posterior.space)
        ranks = (drawn.truth[:, None, :n] > found.quantiles).sum(1)
        held = ((ranks > 0) & (ranks < 19)).double()
        good = found.reliable
        counts = torch.stack([torch.histc(r.double(), CLASSES, 0, 20) for r in ranks[good].T])
        said = [f"{type(model).__name__} {signal}: {drivers} drivers, {seconds:.0f} CPU s"]
        said.append(f"reliable {float(good.double().mean()):.0%}")
        said.append(f"held by reliable {float(held[good].mean()):.1%}")
        each = " ".join(f"{float(share):.0%}" for share in held[good].mean(0))
        said.append(f"each parameter {each}")
        if not bool(good.all()):
            said.append(f"by others {float(held[~good].mean()):.1%}")
        said.append("ranks, all parameters: " + " ".join(f"{c:.0f}" for c in counts.sum(0)))
        least = min(float(chisquare(one).pvalue) for one in counts.numpy())
        yield ", ".join([*said, f"least p of uniform ranks, of {n} parameters: {least:.3f}"])


def recording(name: str) -> Iterator[str]:
    """Yields what the first seconds of I-80's pairs of 70 s say, and the time for all pairs."""
    settings = CalibrationSettings(posterior="laplace")
    model = MODELS[name]
    for least, seconds in ((700, 15), (700, 30), (700, 60), (700, None), (0, None)):
        pairs = TidyDataset(path=I80, min_frames=max(least, 2)).load()
        batch = PairBatch.of(pairs, dtype=torch.float64)
        last = batch.lengths - 1
        if seconds is not None:
            last = last.clamp(max=round(seconds / batch.dt))
        solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
        best = model.space.defaults().double().expand(len(batch), -1)
        started = time.process_time()
        found = parameter_intervals(solver, batch, last, best, settings)
        spent = time.process_time() - started
        rows = []
        for column, parameter in enumerate(found.names):
            known = float((found.contraction[:, column] >= DETERMINED).double().mean())
            low = float(found.low[:, column].median())
            high = float(found.high[:, column].median())
            rows.append(f"{parameter} {known:.0%} ({low:.2g} to {high:.2g})")
        reliable = float((found.pareto_k <= 0.7).double().mean())
        yield (
            f"{type(model).__name__}, {len(batch)} pairs, {seconds or 'all'} s, reliable"
            f" {reliable:.0%}, {spent:.1f} CPU s: {', '.join(rows)}"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    for line in {"coverage": coverage, "recording": recording}[sys.argv[1]](sys.argv[2]):
        print(line, flush=True)
