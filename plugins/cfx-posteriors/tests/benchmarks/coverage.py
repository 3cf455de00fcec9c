"""How often 90 % intervals hold the truth, whatever the noise: what docs/how-to/uncertainty.md says.

python -m plugins.cfx-posteriors.tests.benchmarks.coverage MODEL METHOD [DRIVERS] [SECONDS ...] [--seed N]

Drivers and noise are simulated by `simulated_drivers`, which shares no code with cfx; the kind of
noise is left to `calibration.noise=chosen`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import torch

import cfx
from cfx.calibration.posterior import posterior_method
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.settings import CalibrationSettings, are_reliable
from cfx.calibration.shards import Solver
from cfx.core.registry import create
from cfx.data.pairs import PairBatch
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper

from .simulated_drivers import simulate

I80 = Path("../shared/data/i80_reconstructed_pairs.parquet")
NOISES = ("trajectory", "acceleration", "measurement")
SECONDS = (30.0, 60.0, 120.0)
SEED = 7
DRIVERS = {"krauss": 200, "idm": 120, "w99": 40}


def rows(
    name: str, method: str, drivers: int, durations: Sequence[float], seed: int
) -> Iterator[str]:
    """Yields a row of a Markdown table for each kind of noise and duration."""
    model = cast(DrivingModel, create("model", {"name": name}))
    names = list(model.space.names)
    yield f"| noise | s | chosen | held | settled | held by these | {' | '.join(names)} |"
    for noise in NOISES:
        for seconds in durations:
            recordings, truth = simulate(name, noise, drivers, seconds, seed=seed, recording=I80)
            pairs = cfx.read(recordings, min_duration=0, check="off").selected
            batch = PairBatch.of(pairs, dtype=torch.float64)
            solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
            defaults = model.space.defaults().double().expand(drivers, -1)
            settings = CalibrationSettings(posterior=method)
            last = batch.lengths - 1
            found = posterior_method(method).find(solver, batch, last, defaults, settings)
            columns = found.columns()
            held = []
            for parameter in names:
                value = truth[parameter].to_numpy()
                low, high = columns[f"low_{parameter}"], columns[f"high_{parameter}"]
                held.append((low <= value) & (value <= high))
            within = np.stack(held, axis=1)
            settled = np.asarray(are_reliable(pd.DataFrame(columns)))
            cells = [noise, f"{seconds:.0f}", columns["noise"][0], f"{within.mean():.0%}"]
            cells += [f"{settled.mean():.0%}", f"{within[settled].mean():.0%}"]
            cells += [f"{share:.0%}" for share in within.mean(axis=0)]
            yield f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("model")
    parser.add_argument("method")
    parser.add_argument("drivers", type=int, nargs="?")
    parser.add_argument("seconds", type=float, nargs="*", default=SECONDS)
    parser.add_argument("--seed", type=int, default=SEED, help="of drivers and noise")
    given = parser.parse_args()
    count = given.drivers or DRIVERS[given.model]
    for line in rows(given.model, given.method, count, given.seconds, given.seed):
        print(line, flush=True)
