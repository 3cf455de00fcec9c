"""A rival of the benchmark. This one keeps the time gap that drivers have in the mean.

`cfx benchmark` calls `fit` once for each fold, with the pairs that it may learn from, and drives
the drivers of the fold with what that returns.
"""

from __future__ import annotations

import torch
from cfx.plugin import PairBatch, PairSet, Settings
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver
from pydantic import Field


class MeanTimeGapSettings(Settings):
    """Settings of `mean_time_gap`."""

    reaction_s: float = Field(2.0, gt=0, description="s in which an error of the gap is driven out")


class MeanTimeGap(Rival):
    """Keeps 2 m and the mean time gap of the drivers that it has learned from."""

    reference = "this file"
    schema = MeanTimeGapSettings
    settings: MeanTimeGapSettings

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        batch = PairBatch.of(pairs)  # tensors `(P, T)`; `mask` says which frames there are
        moves = batch.mask & (batch.follower_speed > 1.0)
        time_gaps = (batch.gap[moves] - 2.0) / batch.follower_speed[moves]
        return KeepsTimeGap(float(time_gaps.median()), self.settings.reaction_s)


class KeepsTimeGap(StepDriver):
    """Says an acceleration from what each follower sees now."""

    def __init__(self, time_gap: float, reaction_s: float) -> None:
        self.time_gap, self.reaction_s = time_gap, reaction_s

    def accelerations(
        self, seen: Seen, memory: torch.Tensor, generator: torch.Generator | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        speed = seen.follower_speed[:, -1]  # of each of P followers; -1 is now
        spare = seen.gap[:, -1] - 2.0 - self.time_gap * speed
        closing = seen.leader_speed[:, -1] - speed
        wanted = (spare / self.reaction_s + closing) / self.reaction_s
        return wanted.clamp(-8.0, 3.0), memory
