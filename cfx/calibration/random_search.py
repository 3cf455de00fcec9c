"""The optimizer `random`: space-filling points.

I. M. Sobol' (1967), *On the distribution of points in a cube and the approximate evaluation of
integrals*; scrambling after A. B. Owen (1998) and J. Matousek (1998), as PyTorch implements it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from cfx.calibration.optimizers import (
    AT_ONCE,
    CandidateLosses,
    Optimizer,
    Tried,
    check_room,
    sobol,
)
from cfx.core.component import Settings


class RandomSettings(Settings):
    """Settings of `RandomSearch`."""

    samples: int = Field(4096, ge=1, description="evaluations of each problem, guesses included")


class RandomSearch(Optimizer):
    """Evaluates the guesses and the same scrambled Sobol points in every problem.

    The points are the same for every problem, so that neighbouring windows are compared on the same
    ground, and a problem's result does not depend on its companions.
    """

    schema: ClassVar[type[Settings]] = RandomSettings
    settings: RandomSettings
    trial: ClassVar[Mapping[str, Any]] = {"samples": 1024}
    in_threads = True

    def evaluations(self, n: int) -> int:
        return self.settings.samples

    def evaluations_at_once(self, n: int) -> int:
        return min(AT_ONCE, self.settings.samples)

    def bytes_per_problem(self, n: int) -> int:
        return 8 * self.evaluations_at_once(n) * (n + 2)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tried, Tensor]:
        problems, g, n = guesses.shape
        check_room(self.settings.samples, g, key="samples")
        points = sobol(self.settings.samples - g, n, seed=seed, device=guesses.device)
        blocks = (guesses, points.expand(problems, -1, -1))
        losses = torch.cat([objective(guesses), objective(blocks[1])], dim=1)
        return blocks, losses
