"""Differential evolution, the usual calibrator of car-following models, for many problems at once.

R. Storn and K. Price (1997), *Differential evolution - a simple and efficient heuristic for global
optimization over continuous spaces*, Journal of Global Optimization 11; as
`scipy.optimize.differential_evolution` implements it.

SciPy solves one problem at a time, and asks for a generation's losses by calling a function. Here
each problem's solver runs as a greenlet (a coroutine that may pause in the middle of any function):
when it calls, it pauses. Once all solvers have paused, their generations are evaluated together,
and each solver goes on with its losses. SciPy's public function does all the work, unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from greenlet import greenlet
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import CandidateLosses, Optimizer, Settings

Floats = NDArray[np.float64]

_LARGEST = 1e100
"""Losses are cut here, infinity too: SciPy takes their standard deviation, and only their order
matters to the search."""


Strategy = Literal[
    "best1bin",
    "best1exp",
    "rand1bin",
    "rand1exp",
    "rand2bin",
    "rand2exp",
    "randtobest1bin",
    "randtobest1exp",
    "currenttobest1bin",
    "currenttobest1exp",
    "best2exp",
    "best2bin",
]
"""SciPy's strategies."""


class DifferentialEvolutionSettings(Settings):
    """Settings of `DifferentialEvolution`; names and defaults are SciPy's where it has them."""

    population: int = Field(
        20,
        ge=5,
        description="candidates in a generation; the first are guesses and space-filling points",
    )
    generations: int = Field(
        14,
        ge=0,
        description="generations after the first; evaluations = population * (generations + 1)",
    )
    strategy: Strategy = Field(
        "best1bin", description="how a candidate is made from others, in SciPy's names"
    )
    mutation_low: float = Field(0.5, ge=0, lt=2, description="least weight of a difference")
    mutation_high: float = Field(
        1.0,
        gt=0,
        lt=2,
        description="greatest weight of a difference; drawn anew in each generation",
    )
    recombination: float = Field(
        0.7, ge=0, le=1, description="probability with which a parameter is taken from the mutant"
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.mutation_low > self.mutation_high:
            raise ValueError(
                f"optimizer.mutation_low={self.mutation_low:g} is above"
                f" optimizer.mutation_high={self.mutation_high:g}; give a range"
            )
        return self


class DifferentialEvolution(Optimizer):
    """One `scipy.optimize.differential_evolution` for each problem.

    The generations of all problems are evaluated in one call. Every problem draws the same random
    numbers, made from the seed alone, so its result does not depend on its companions.

    Differences from SciPy's defaults: the size of the population does not grow with the number of
    parameters, so that all models get the same evaluations; the search is not stopped when the
    population has converged, and not polished by a gradient method, so that every problem gets the
    same evaluations. A population without differences, which cannot change any more, spends the
    rest on its best candidate.
    """

    schema: ClassVar[type[Settings]] = DifferentialEvolutionSettings
    settings: DifferentialEvolutionSettings
    trial: ClassVar[Mapping[str, Any]] = {"population": 12, "generations": 11}

    def evaluations(self, n: int) -> int:
        return self.settings.population * (self.settings.generations + 1)

    def evaluations_at_once(self, n: int) -> int:
        return self.settings.population

    def space_filling(self, n: int) -> int:
        return self.settings.population

    def bytes_per_problem(self, n: int) -> int:
        # A paused solver took 25 kB at 9 parameters: its frames, its part of the stack, and about
        # ten arrays of a generation.
        return 60_000 + 8 * 16 * self.settings.population * (n + 2)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        problems, g, n = guesses.shape
        size = self.settings.population
        if g > size:
            raise ConfigError(
                f"optimizer.population={size}: there are {g} first guesses;"
                f" set optimizer.population >= {g}"
            )
        points = _sobol(size - g, n, seed=seed).to(guesses.device)
        candidates = [torch.cat([guesses, points.expand(problems, -1, -1)], dim=1)]
        losses = [objective(candidates[0])]
        searches = [_Search(start, self.settings, seed) for start in candidates[0].cpu().numpy()]
        for _ in range(self.settings.generations):
            generation = []
            for search, loss in zip(searches, losses[-1].cpu().numpy(), strict=True):
                generation.append(search.tell(loss))
            candidates.append(torch.from_numpy(np.stack(generation)).to(guesses.device))
            losses.append(objective(candidates[-1]))
        return torch.cat(candidates, dim=1), torch.cat(losses, dim=1)


class _Search:
    """SciPy's solver of one problem, paused wherever it wants to know losses."""

    def __init__(self, start: Floats, settings: DifferentialEvolutionSettings, seed: int) -> None:
        """Takes the first generation `(size, n)`."""
        self._start = start
        self._settings = settings
        self._seed = seed
        self._solver = greenlet(self._solve)
        # Up to the question for the first generation's losses, which the caller has.
        self._solver.switch()

    def tell(self, losses: Floats) -> Floats:
        """Takes the losses `(size,)` of the last generation and returns the next one.

        Returns:
            `(size, n)` within [0, 1].
        """
        generation: Floats = self._solver.switch(np.clip(losses, -_LARGEST, _LARGEST))
        return np.clip(generation, 0.0, 1.0)

    def _solve(self) -> Floats:
        from scipy.optimize import Bounds, differential_evolution

        s, n = self._settings, self._start.shape[1]
        solution = differential_evolution(
            self._ask,
            bounds=Bounds(np.zeros(n), np.ones(n)),
            init=self._start,
            strategy=s.strategy,
            maxiter=s.generations,
            mutation=(s.mutation_low, s.mutation_high),
            recombination=s.recombination,
            tol=0,
            atol=0,
            rng=np.random.default_rng(self._seed),
            polish=False,
            vectorized=True,
            updating="deferred",
        )
        # SciPy ends early where all losses are equal: whatever is asked from now on, the answer is
        # its best candidate.
        while True:
            self._ask(np.repeat(solution.x[:, None], s.population, axis=1))

    def _ask(self, candidates: Floats) -> Any:
        """Pauses with a generation `(n, size)` and returns its losses."""
        main = self._solver.parent
        assert main is not None
        return main.switch(candidates.T)


def _sobol(count: int, n: int, *, seed: int) -> Tensor:
    """Returns `count` scrambled Sobol points `(count, n)` within [0, 1], float64."""
    if count == 0:
        return torch.empty((0, n), dtype=torch.float64)
    # torch leaves the engine untyped.
    make: Any = torch.quasirandom.SobolEngine
    engine = make(n, scramble=True, seed=seed)
    points: Tensor = engine.draw(count, dtype=torch.float64)
    return points
