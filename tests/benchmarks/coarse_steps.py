"""How far calibrated parameters are off where a recording's time step is coarse.

    python -m tests.benchmarks.coarse_steps idm

Twelve drivers of known parameters drive in steps of 0.02 s; every k-th frame is kept, and the
drivers are calibrated: as recorded, and resampled to 0.1 s. Prints the median bias in per cent.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.optimizers.gradient import GradientSearch
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.data.pairs import SIGNALS, Pair, PairBatch, PairSet
from cfx.data.resample import resampled
from cfx.models.base import DrivingModel, Leader
from cfx.simulation.rollout import MemoryStepper, simulate
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.trajectory import Start

DRIVERS, DT = 12, 0.02


def driven(model: DrivingModel) -> tuple[PairSet, Tensor]:
    """Returns the drivers, and their parameters `(DRIVERS, n)`."""
    made = SyntheticDataset(
        pairs=DRIVERS,
        platoon_size=1,
        frames=3000,
        dt=DT,
        variation=0.0,
        noise_speed_mps=0,
        noise_position_m=0,
        seed=1,
        min_frames=2,
    ).load()
    batch = PairBatch.of(made)
    draw = torch.Generator().manual_seed(0)
    default = model.space.to_unit(model.space.defaults())
    noise = torch.rand((DRIVERS, len(default)), generator=draw, dtype=torch.float64) - 0.5
    parameters = model.space.from_unit((default + 0.25 * noise).clamp(0.05, 0.95))
    leader = Leader(
        batch.leader_position, batch.leader_speed, batch.leader_acceleration, batch.leader_length
    )
    start = Start(
        batch.follower_position[:, 0], batch.follower_speed[:, 0], batch.follower_acceleration[:, 0]
    )
    out = simulate(model, parameters, leader, start, DT)
    pairs = []
    for pair, speed, gap in zip(made, out.speed.numpy(), out.gap.numpy(), strict=True):
        position = pair.leader_position - pair.leader_length - gap
        signals: dict[str, Any] = {"follower_position": position, "follower_speed": speed}
        pairs.append(replace(pair, **signals, truth={}, truth_model=""))
    return PairSet(tuple(pairs), "made up"), parameters


def every(pairs: PairSet, k: int) -> PairSet:
    """Returns every k-th frame; accelerations are differences of the speeds that are left."""

    def coarse(pair: Pair) -> Pair:
        signals: dict[str, Any] = {name: getattr(pair, name)[::k] for name in SIGNALS}
        for who in ("leader", "follower"):
            change = np.diff(signals[f"{who}_speed"]) / (k * pair.dt)
            signals[f"{who}_acceleration"] = np.append(change, 0.0)
        return replace(pair, dt=k * pair.dt, **signals)

    return PairSet(tuple(coarse(pair) for pair in pairs), pairs.source)


def bias(model: DrivingModel, pairs: PairSet, truth: Tensor) -> list[float]:
    """Returns the median over drivers of each parameter's bias, per cent."""
    batch = PairBatch.of(pairs)
    solver = Solver(MemoryStepper(model, batch.dt), GradientSearch(), 0)
    found = Calibrator(solver, cache=Cache(None)).fixed(pairs, batch, batch.lengths - 1)
    return [round(100 * one, 1) for one in ((found - truth) / truth).median(0).values.tolist()]


if __name__ == "__main__":
    model = registry.create("model", {"name": sys.argv[1]})
    assert isinstance(model, DrivingModel)
    pairs, truth = driven(model)
    print(model.space.names)
    for k in (2, 5, 10, 25, 50):
        coarse = every(pairs, k)
        print(f"{k * DT:.2f} s", bias(model, coarse, truth), end=" ", flush=True)
        if k > 5:
            print("resampled", bias(model, resampled(coarse, 0.1), truth), end="")
        print()
