"""An optimizer: how calibration searches. This one follows a scrambled Halton sequence.

Calibration calls `solve` once for many independent problems, such as all drivers, or all windows
of a recording; the other methods say beforehand how much work and memory that takes.

A. B. Owen (2017), A randomized Halton algorithm in R, arXiv:1706.02808.
"""

from __future__ import annotations

import torch
from cfx.errors import ConfigError
from cfx.plugin import CandidateLosses, Optimizer, Settings
from pydantic import Field
from scipy.stats import qmc
from torch import Tensor


class HaltonSearchSettings(Settings):
    """Settings of `halton_search`."""

    samples: int = Field(2048, ge=1, description="evaluations of each problem, guesses included")


class HaltonSearch(Optimizer):
    """Evaluates the guesses and, in every problem, the same points of a Halton sequence."""

    schema = HaltonSearchSettings
    settings: HaltonSearchSettings

    def evaluations(self, n: int) -> int:
        return self.settings.samples

    def evaluations_at_once(self, n: int) -> int:
        return self.settings.samples

    def bytes_per_problem(self, n: int) -> int:
        return 8 * self.settings.samples * (n + 1)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        problems, given, n = guesses.shape
        samples = self.settings.samples
        if samples < given:
            raise ConfigError(
                f"optimizer.samples={samples}: there are {given} first guesses;"
                f" set it to {given} or more"
            )
        sequence = qmc.Halton(n, scramble=True, rng=seed)
        points = torch.as_tensor(sequence.random(samples - given)).to(guesses)
        candidates = torch.cat([guesses, points.expand(problems, -1, -1)], dim=1)
        return candidates, objective(candidates)
