"""A posterior: which parameters a recording leaves possible. This one is rejection sampling.

Calibration calls `find` once for many drivers, after it has found their best parameters. Of many
random parameter sets those are kept that fit a driver best.

J. K. Pritchard, M. T. Seielstad, A. Perez-Lezaun and M. W. Feldman (1999), *Population growth of
human Y chromosomes*, Molecular Biology and Evolution 16(12): the simplest approximate Bayesian
computation. The prior is uniform between the bounds. No noise is modelled: how wide intervals are
depends on the share that is kept, so that they compare drivers rather than say what is likely.

Shapes: P drivers, n tuned parameters, S samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from cfx.plugin import (
    INTERVAL_LEVEL,
    CalibrationSettings,
    DriverPosteriors,
    PairBatch,
    ParameterSpace,
    PosteriorMethod,
    SegmentLosses,
    Solver,
)
from numpy.typing import NDArray
from torch import Tensor

SAMPLES = 4000
"""Parameter sets that are simulated for each driver."""

KEPT = 200
"""Of these the ones with the smallest losses, a driver's draws."""


@dataclass(frozen=True)
class Accepted(DriverPosteriors):
    """The parameter sets that were kept.

    Attributes:
        space: of the parameters.
        unit_draws: in unit space, `(P, KEPT, n)`.
        draws: in SI units, `(P, KEPT, n)`.
        smallest_loss: of each driver, `(P,)`, in the objective's unit.
    """

    space: ParameterSpace
    unit_draws: Tensor
    draws: Tensor
    smallest_loss: Tensor

    def columns(self) -> Mapping[str, NDArray[np.float64]]:
        tail = (1.0 - INTERVAL_LEVEL) / 2.0
        shares = torch.tensor([tail, 0.5, 1.0 - tail], dtype=self.draws.dtype)
        low, median, high = self.draws.quantile(shares, dim=1)  # (P, n) each
        unit_low, _, unit_high = self.unit_draws.quantile(shares, dim=1)
        # The prior is uniform, so that its interval is as wide as the level says.
        contraction = 1.0 - (unit_high - unit_low) / INTERVAL_LEVEL
        columns = {}
        for number, name in enumerate(self.space.names):
            columns[f"median_{name}"] = median[:, number].numpy()
            columns[f"low_{name}"] = low[:, number].numpy()
            columns[f"high_{name}"] = high[:, number].numpy()
            columns[f"contraction_{name}"] = contraction[:, number].numpy()
        drivers = len(self.draws)
        columns["noise_scale"] = self.smallest_loss.numpy()
        columns["noise_correlation"] = np.zeros(drivers)
        columns["noise_left"] = np.full(drivers, np.nan)  # nothing is known of it
        columns["effective_samples"] = np.full(drivers, float(self.draws.shape[1]))
        columns["pareto_k"] = np.zeros(drivers)  # all weights are equal: none is too large
        return columns

    def tables(self, ids: Sequence[str]) -> dict[str, pd.DataFrame]:
        return {}

    def draw_drivers(self, count: int, seed: int) -> Tensor:
        return self.space.from_unit(_uniform(count, len(self.space), seed))


class AbcRejection(PosteriorMethod):
    """Keeps the parameter sets with the smallest losses, whatever the objective is."""

    any_simulator = True

    def find(
        self,
        solver: Solver,
        batch: PairBatch,
        last: Tensor,
        best: Tensor,
        settings: CalibrationSettings,
    ) -> DriverPosteriors:
        pairs = torch.arange(len(last), device=last.device)
        first = torch.zeros_like(last)
        losses = solver.segments(batch, pairs, first, last).for_work(SAMPLES)
        space = solver.space
        candidates = _uniform(SAMPLES, len(space), solver.seed).to(last.device)  # (S, n)
        loss = _losses_of(losses, candidates, solver.memory)  # (P, S)
        kept = loss.topk(KEPT, dim=1, largest=False)
        unit = candidates[kept.indices].cpu()  # (P, KEPT, n)
        smallest = kept.values[:, 0].double().cpu()
        return Accepted(space, unit, space.from_unit(unit), smallest)


def _uniform(count: int, width: int, seed: int) -> Tensor:
    """Returns random numbers in unit space, `(count, width)`; others' are left alone."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand((count, width), generator=generator, dtype=torch.float64)


def _losses_of(losses: SegmentLosses, candidates: Tensor, memory: int) -> Tensor:
    """Returns the loss of each candidate `(S, n)` for each driver, `(P, S)`.

    As many are simulated at once as the memory (bytes) holds. What diverges has the loss infinity.
    """
    drivers = losses.problems
    at_once = max(1, memory // (drivers * losses.bytes_per_candidate))
    parts = []
    for first in range(0, len(candidates), at_once):
        some = candidates[first : first + at_once]
        parts.append(losses(some.expand(drivers, -1, -1)))
    return torch.cat(parts, dim=1).nan_to_num(nan=torch.inf)
