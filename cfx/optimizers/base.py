"""The contract of an optimizer: many independent bounded problems in one call.

Letters: P problems, q candidates for each, n parameters, e evaluations of each problem in all.
Everything here is float64: Gaussian processes need it, and losses of neighbouring candidates differ by little.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from cfx.component import Component

Progress = Callable[[int], None]
"""Told how many more problems' evaluations are done (problems times evaluations)."""


class Objective(Protocol):
    """P independent problems that are evaluated together."""

    @property
    def problems(self) -> int:
        """P."""
        ...

    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(P, q)` of candidates `(P, q, n)` in unit space; NaN or infinity where a candidate diverges."""
        ...

    def select(self, first: int, last: int) -> Objective:
        """Returns the objective of problems `first` to `last - 1` alone."""
        ...


@dataclass(frozen=True)
class Solution:
    """What an optimizer found.

    Attributes:
        best: `(P, n)` in unit space.
        loss: `(P,)`, its loss; infinity if every candidate of a problem diverged (then `best` is the first guess).
        candidates: `(P, e, n)`, everything that was evaluated, in order.
        losses: `(P, e)`; diverged candidates are infinity.
    """

    best: Tensor
    loss: Tensor
    candidates: Tensor
    losses: Tensor


class Optimizer(Component):
    """Base of every optimizer.

    Life cycle: calibration calls `minimize` once per group of problems; `minimize` cuts it into chunks that respect the memory
    bound, calls `solve` for each, and checks what comes back. A subclass implements `solve` and
    `bytes_per_problem`. The result for a problem must not depend on which other problems stand beside it, beyond rounding.
    """

    kind = "optimizer"

    @abstractmethod
    def solve(self, objective: Objective, guesses: Tensor, *, n: int, seed: int, progress: Progress) -> tuple[Tensor, Tensor]:
        """Evaluates candidates of all problems of one chunk.

        Args:
            objective: returns finite losses or infinity, never NaN.
            guesses: `(P, g, n)` in unit space, candidates worth trying first; they count as evaluations.
            n: number of parameters.
            seed: the same for every chunk.
            progress: to be told of each evaluation: `progress(problems * evaluations)`.

        Returns:
            Candidates `(P, e, n)` within [0, 1] and their losses `(P, e)`.
        """

    @abstractmethod
    def evaluations(self) -> int:
        """Returns e, the number of evaluations of each problem."""

    @abstractmethod
    def bytes_per_problem(self, n: int) -> int:
        """Returns an upper estimate of the memory that one problem needs in `solve`, without the objective's own."""

    def minimize(
        self,
        objective: Objective,
        guesses: Tensor,
        *,
        seed: int,
        objective_bytes: int = 0,
        memory: int = 1 << 30,
        progress: Progress = lambda done: None,
    ) -> Solution:
        """Solves all problems of `objective`.

        Args:
            guesses: `(P, g, n)` in unit space, g >= 1.
            seed: the same seed gives the same result.
            objective_bytes: memory that the objective needs for one candidate of one problem.
            memory: bound in bytes for one chunk.
            progress: called with the number of evaluations done.
        """
        n = guesses.shape[-1]
        each = self.bytes_per_problem(n) + objective_bytes * self.evaluations_at_once()
        chunk = max(1, min(objective.problems, memory // max(1, each)))
        pieces = []
        for first in range(0, objective.problems, chunk):
            last = min(first + chunk, objective.problems)
            safe = _Finite(objective.select(first, last))
            candidates, losses = self.solve(safe, guesses[first:last].double(), n=n, seed=seed, progress=progress)
            pieces.append((candidates.clamp(0.0, 1.0), losses))
        candidates = torch.cat([piece[0] for piece in pieces])
        losses = torch.cat([piece[1] for piece in pieces])
        loss, index = losses.min(dim=1)
        best = candidates.gather(1, index[:, None, None].expand(-1, 1, n)).squeeze(1)
        return Solution(best, loss, candidates, losses)

    def evaluations_at_once(self) -> int:
        """Returns how many candidates of one problem `solve` hands to the objective in one call; 1 unless overridden."""
        return 1


class _Finite:
    """An objective whose NaN losses are infinity."""

    def __init__(self, objective: Objective) -> None:
        self._objective = objective

    @property
    def problems(self) -> int:
        return self._objective.problems

    def __call__(self, candidates: Tensor) -> Tensor:
        return self._objective(candidates).double().nan_to_num(nan=torch.inf, posinf=torch.inf)

    def select(self, first: int, last: int) -> Objective:
        return _Finite(self._objective.select(first, last))
