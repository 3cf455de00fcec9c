"""How far calibrated parameters are off where a recording's time step is coarse.

    python -m tests.benchmarks.coarse_steps idm krauss w99 --figure docs/coarse_steps.png

Twelve drivers of known parameters drive in steps of 0.02 s; every k-th frame is kept, and the
drivers are calibrated: as recorded; resampled to 0.1 s, and to the 0.02 s of the truth; and with
the model's steps of 0.1 s between recorded frames, the leader interpolated, where only recorded
frames count. Prints the median bias in per cent, and draws some of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.objectives import FrameValues, Objective
from cfx.calibration.rmse import SpeedRmse
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.data.resampling import resampled
from cfx.data.signals import RECORDED as SIGNALS
from cfx.models.base import DrivingModel, Leader
from cfx.simulation.rollout import MemoryStepper, simulate_follower
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.trajectory import Start

DRIVERS, DT = 12, 0.02
STRIDES = (2, 5, 10, 25, 50)
FINE_S = 0.1

RECORDED, RESAMPLED, SUB_STEPS, AS_DRIVEN = (
    "as recorded",
    "resampled to 0.1 s",
    "sub-steps of 0.1 s",
    "resampled to 0.02 s",
)
DRAWN = {"idm": ("T", "s0", "v0"), "krauss": ("t_r",), "w99": ("cc0", "cc1")}
"""Parameters in the figure: of following, standing, and free driving."""

_NOT_RECORDED_M = 1e6
"""Added to a position between recorded frames, so that the objective knows it by the gap."""


class RecordedFrames(SpeedRmse):
    """RMSE of speed over recorded frames alone: one of `stride`."""

    signals = ("speed", "gap")

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stride = stride

    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        is_recorded = frames.measured_gap > -0.5 * _NOT_RECORDED_M
        (square,) = super().terms(frames)
        return (square * is_recorded * self.stride,)


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
        min_duration=0,
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
    out = simulate_follower(model, parameters, leader, start, DT)
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


def with_sub_steps(pairs: PairSet) -> tuple[PairSet, Objective]:
    """Returns pairs in steps of 0.1 s, and an objective of which only recorded frames are part."""
    stride = round(pairs[0].dt / FINE_S)

    def marked(pair: Pair) -> Pair:
        position = np.array(pair.follower_position)
        position[np.arange(len(pair)) % stride != 0] += _NOT_RECORDED_M
        return replace(pair, follower_position=position)

    return resampled(pairs, FINE_S).changed(marked), RecordedFrames(stride)


def bias(
    model: DrivingModel, pairs: PairSet, truth: Tensor, objective: Objective | None = None
) -> list[float]:
    """Returns the median over drivers of each parameter's bias, per cent."""
    batch = PairBatch.of(pairs)
    stepper = MemoryStepper(model, batch.dt)
    solver = Solver(stepper, GradientSearch(), 0, objective or SpeedRmse())
    found = Calibrator(solver, cache=Cache(None)).driver_specific(pairs, batch, batch.lengths - 1)
    return [round(100 * one, 1) for one in ((found - truth) / truth).median(0).values.tolist()]


def biases(
    model: DrivingModel, pairs: PairSet, truth: Tensor, stride: int
) -> Iterator[tuple[str, list[float]]]:
    """Yields the biases of recordings that keep one frame of `stride`, by how they are used."""
    coarse = every(pairs, stride)
    yield RECORDED, bias(model, coarse, truth)
    if coarse[0].dt > FINE_S:
        yield RESAMPLED, bias(model, resampled(coarse, FINE_S), truth)
        fine, objective = with_sub_steps(coarse)
        yield SUB_STEPS, bias(model, fine, truth, objective)
    yield AS_DRIVEN, bias(model, resampled(coarse, DT), truth)


Row = tuple[str, tuple[str, ...], float, str, list[float]]
"""Model, its parameters, the recording's step in s, how it was used, and the biases in per cent."""


def draw(rows: list[Row], path: Path) -> None:
    """Draws the bias of some parameters against the step of the recording."""
    from matplotlib.figure import Figure

    panels = [(model, name) for model, names in DRAWN.items() for name in names]
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = list(figure.subplots(2, 3, sharex=True).flat)
    for axis, (model, name) in zip(axes, panels, strict=True):
        for way in (RECORDED, RESAMPLED, SUB_STEPS, AS_DRIVEN):
            points = []
            for of, names, step, used, found in rows:
                if (of, used) == (model, way):
                    points.append((step, found[names.index(name)]))
            axis.plot(*zip(*sorted(points), strict=True), marker="o", markersize=3, label=way)
        axis.axhline(0.0, color="0.6", linewidth=0.8)
        axis.set_title(f"{model}: {name}", fontsize=9)
        axis.set_xscale("log")
        axis.set_xticks([0.04, 0.1, 0.2, 0.5, 1.0], ["0.04", "0.1", "0.2", "0.5", "1"])
        axis.minorticks_off()
    figure.supxlabel("time step of the recording, s", fontsize=9)
    figure.supylabel("median bias, per cent", fontsize=9)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The bias of parameters in coarse time steps.")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--figure", type=Path, help="idm, krauss and w99: where to draw it")
    options = parser.parse_args()
    rows: list[Row] = []
    for name in options.models:
        model = registry.create("model", {"name": name})
        assert isinstance(model, DrivingModel)
        pairs, truth = driven(model)
        print(name, *model.space.names)
        for stride in STRIDES:
            for way, found in biases(model, pairs, truth, stride):
                print(f"{stride * DT:.2f} s, {way}:", *found, flush=True)
                rows.append((name, model.space.names, stride * DT, way, found))
    if options.figure:
        draw(rows, options.figure)
