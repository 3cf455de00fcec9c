"""CMA-ES, the covariance matrix adaptation evolution strategy, for many problems at once.

N. Hansen and A. Ostermeier (2001), *Completely derandomized self-adaptation in evolution
strategies*, Evolutionary Computation 9(2); restarts after A. Auger and N. Hansen (2005),
*Performance evaluation of an advanced local search evolutionary algorithm*, IEEE CEC. The
implementation is Hansen's own: the package `cma`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import CandidateLosses, Optimizer, Settings

if TYPE_CHECKING:
    Floats = NDArray[np.float64]

_LARGEST = 1e100
"""Losses are cut here, infinity too: cma squares and subtracts them, and only their order matters
to it."""

_MOST_PER_GENERATION = 18
"""4 + 3 ln n at 100 parameters: more than any driving model has."""


class CmaSettings(Settings):
    """Settings of `CmaOptimizer`."""

    samples: int = Field(300, ge=1, description="evaluations of each problem, guesses included")
    initial: int = Field(
        16,
        ge=1,
        description="first evaluations, guesses and space-filling points; the search starts at the"
        " best of them, and their losses say how much the choice of parameters matters",
    )
    population: int | None = Field(
        None, ge=4, description="candidates in a generation; null: 4 + 3 ln n, as cma has it"
    )
    sigma: float = Field(
        0.25, gt=0, le=1, description="first standard deviation of a search, in unit space"
    )


class CmaOptimizer(Optimizer):
    """One `cma.CMAEvolutionStrategy` for each problem.

    The generations of all problems are evaluated in one call. A search that has converged, or that
    sees only equal losses, starts again at a random point until the evaluations are spent. Every
    problem draws the same random numbers, made from the seed alone, so its result does not depend
    on its companions.

    Differences from `cma.fmin2`: the start is the best of a few space-filling points, and restarts
    keep the size of the population. Bounds are kept by cma's own transformation.
    """

    schema: ClassVar[type[Settings]] = CmaSettings
    settings: CmaSettings
    trial: ClassVar[Mapping[str, Any]] = {"samples": 90, "initial": 8}

    def evaluations(self, n: int) -> int:
        return self.settings.samples

    def evaluations_at_once(self, n: int) -> int:
        return max(self._initial, self.settings.population or _MOST_PER_GENERATION)

    def space_filling(self, n: int) -> int:
        return self._initial

    def bytes_per_problem(self, n: int) -> int:
        # An evolution strategy took 30 kB at 9 parameters; it holds about ten (n, n) matrices.
        return 50_000 + 8 * (12 * n * n + 3 * self.evaluations_at_once(n) * (n + 2))

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        problems, g, n = guesses.shape
        if g > self._initial:
            raise ConfigError(
                f"there are {g} first guesses; set optimizer.initial and optimizer.samples to at"
                f" least {g} (they are {self.settings.initial} and {self.settings.samples})"
            )
        points = _sobol(self._initial - g, n, seed=seed).to(guesses.device)
        candidates = [torch.cat([guesses, points.expand(problems, -1, -1)], dim=1)]
        losses = [objective(candidates[0])]
        best = losses[0].argmin(dim=1)[:, None, None].expand(-1, 1, n)
        starts = candidates[0].gather(1, best).squeeze(1)
        size = self.settings.population or 4 + int(3 * math.log(n))
        searches = [
            _Search(start, size, self.settings.sigma, seed) for start in starts.cpu().numpy()
        ]
        left = self.settings.samples - self._initial
        while left > 0:
            generation = np.stack([search.ask() for search in searches])[:, :left]
            candidates.append(torch.from_numpy(generation).to(guesses.device))
            losses.append(objective(candidates[-1]))
            if left > size:
                for search, loss in zip(searches, losses[-1].cpu().numpy(), strict=True):
                    search.tell(loss)
            left -= generation.shape[1]
        return torch.cat(candidates, dim=1), torch.cat(losses, dim=1)

    @property
    def _initial(self) -> int:
        return min(self.settings.initial, self.settings.samples)


class _Search:
    """CMA-ES of one problem of n parameters, started again whenever it ends."""

    def __init__(self, start: Floats, size: int, sigma: float, seed: int) -> None:
        self._n = len(start)
        self._size = size
        self._sigma = sigma
        self._random = np.random.default_rng(seed)
        self._strategy = self._begin(start)
        self._asked: list[Floats] = []

    def ask(self) -> Floats:
        """Returns one generation `(size, n)` within [0, 1]."""
        self._asked = self._strategy.ask()
        # cma's transformation may leave the bounds by a rounding error.
        return np.clip(np.stack(self._asked)[:, : self._n], 0.0, 1.0)

    def tell(self, losses: Floats) -> None:
        """Takes the losses `(size,)` of the generation that was asked for last."""
        self._strategy.tell(self._asked, np.clip(losses, -_LARGEST, _LARGEST).tolist())
        if self._strategy.stop():
            self._strategy = self._begin(self._random.random(self._n))

    def _begin(self, start: Floats) -> Any:
        from cma import CMAEvolutionStrategy

        # cma refuses to search in one dimension: it gets a second one, which changes nothing.
        if self._n == 1:
            start = np.append(start, 0.5)
        options = {
            "bounds": [0.0, 1.0],
            "popsize": self._size,
            # Its own random numbers instead of numpy's global ones, which `seed` would set.
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": np.nan,
            "verbose": -9,
            "verb_disp": 0,
            "verb_log": 0,
        }
        return CMAEvolutionStrategy(start, self._sigma, options)


def _sobol(count: int, n: int, *, seed: int) -> Tensor:
    """Returns `count` scrambled Sobol points `(count, n)` within [0, 1], float64."""
    if count == 0:
        return torch.empty((0, n), dtype=torch.float64)
    # torch leaves the engine untyped.
    make: Any = torch.quasirandom.SobolEngine
    engine = make(n, scramble=True, seed=seed)
    points: Tensor = engine.draw(count, dtype=torch.float64)
    return points
