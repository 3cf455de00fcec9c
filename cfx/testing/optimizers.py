"""The contract of an optimizer, as tests: subclass `OptimizerContract`, fill in the fixture `optimizer`; pytest does the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cfx.optimizers.base import Objective, Optimizer, Solution

Function = Callable[[Tensor, Tensor], Tensor]
"""Losses `(P, q)` of candidates `(P, q, n)`, given what tells problems apart, `(P, n)`."""


class Problems:
    """P functions as an objective, which remembers what it was asked."""

    def __init__(self, function: Function, traits: Tensor, asked: list[Tensor] | None = None) -> None:
        self._function = function
        self._traits = traits
        self.asked = [] if asked is None else asked

    @property
    def problems(self) -> int:
        """P."""
        return len(self._traits)

    def __call__(self, candidates: Tensor) -> Tensor:
        assert candidates.shape[0] == self.problems, "an objective is asked about all its problems at once"
        self.asked.append(candidates.detach().clone())
        return self._function(candidates, self._traits[:, None])

    def select(self, first: int, last: int) -> Problems:
        """Returns problems `first` to `last - 1`; what they are asked is remembered here."""
        return Problems(self._function, self._traits[first:last], self.asked)


def distance(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the distance to the optimum: a kink there, as the RMSE of a drive has."""
    return (candidates - optimum).square().sum(dim=-1).sqrt()


def bowl(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the squared distance to the optimum, on an offset: a loss that never becomes 0."""
    return distance(candidates, optimum).square() + 0.1


def rugged(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns a function with kinks, jumps, negative values and, here and there, NaN."""
    away = candidates - optimum
    loss = (away.abs() + 0.3 * torch.sin(20.0 * away) + (away > 0.3)).sum(dim=-1) - 0.5
    return loss.where(torch.sin(50.0 * away[..., 0]) < 0.9, torch.nan)


def flat(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the same loss everywhere."""
    return torch.full_like(distance(candidates, optimum), 0.25)


def zero(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns 0 everywhere."""
    return torch.zeros_like(distance(candidates, optimum))


def some_nan(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the distance, but NaN for half of the candidates."""
    return distance(candidates, optimum).where(candidates[..., 0] < 0.5, torch.nan)


def some_infinite(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the distance, but infinity for half of the candidates."""
    return distance(candidates, optimum).where(candidates[..., 0] < 0.5, torch.inf)


def all_nan(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns NaN everywhere."""
    return torch.full_like(distance(candidates, optimum), torch.nan)


def steps(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the distance in coarse steps: many candidates tie."""
    return (4.0 * distance(candidates, optimum)).round()


def enormous(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns losses over hundreds of orders of magnitude."""
    return torch.exp(1400.0 * distance(candidates, optimum) - 700.0)


def corner(candidates: Tensor, _: Tensor) -> Tensor:
    """Returns a function that is least in the corner (1, ..., 1)."""
    return (2.0 - candidates).square().mean(dim=-1)


class OptimizerContract:
    """What every optimizer must hold. Letters as in `cfx.optimizers.base`.

    Attributes:
        tolerance: how far in unit space from a known optimum of two parameters the optimizer may end.
    """

    tolerance: ClassVar[float] = 0.05

    @pytest.fixture
    def optimizer(self) -> Optimizer:
        """Returns the optimizer under test; choose few evaluations, for it runs some thirty times."""
        raise NotImplementedError("the subclass of OptimizerContract must define the fixture `optimizer`")

    @pytest.mark.parametrize("function", [distance, bowl])
    def test_recovers_a_known_optimum(self, optimizer: Optimizer, function: Function) -> None:
        optima = _random(8, 2, seed=11)
        found = _solve(optimizer, Problems(function, optima), n=2)
        worst = torch.linalg.vector_norm(found.best - optima, dim=-1).max().item()
        assert worst <= self.tolerance, (
            f"the optimum of a smooth function was missed by {worst:.3g}; allowed are {self.tolerance}"
        )

    def test_never_leaves_the_bounds(self, optimizer: Optimizer) -> None:
        # An inner function, because Hypothesis keeps its state on what it decorates and every subclass shares this one.
        @settings(max_examples=4, deadline=None, derandomize=True)
        @given(n=st.integers(1, 5), guesses=st.integers(1, 3), seed=st.integers(0, 1000))
        def holds(n: int, guesses: int, seed: int) -> None:
            problems = Problems(rugged, 1.5 * _random(16, n, seed=seed) - 0.25)
            found = _solve(optimizer, problems, n=n, guesses=guesses, seed=seed)
            for asked in [*problems.asked, found.best]:
                inside = bool(((asked >= 0) & (asked <= 1)).all())
                assert inside, "a candidate lies outside [0, 1]: a model would drive with parameters outside its bounds"

        holds()

    @pytest.mark.parametrize("n", [1, 3])
    @pytest.mark.parametrize("function", [flat, zero, some_nan, some_infinite, all_nan, steps, enormous, corner])
    def test_survives(self, optimizer: Optimizer, function: Function, n: int) -> None:
        found = _solve(optimizer, Problems(function, _random(2, n, seed=5)), n=n)
        assert bool(found.best.isfinite().all()), "the parameters of a window must be numbers whatever its losses are"
        assert not bool(found.loss.isnan().any()), "a loss is a number, or infinity where every candidate diverged"

    def test_survives_duplicate_guesses(self, optimizer: Optimizer) -> None:
        optima = _random(3, 2, seed=5)
        guesses = optima[:, None].expand(-1, 3, -1)
        found = optimizer.minimize(Problems(distance, optima), guesses, seed=1)
        torch.testing.assert_close(found.best, optima, msg="the guesses were the optimum: it must be returned")

    def test_finds_a_corner(self, optimizer: Optimizer) -> None:
        found = _solve(optimizer, Problems(corner, _random(3, 2, seed=5)), n=2)
        reached = found.best.min().item()
        assert reached >= 1 - 2 * self.tolerance, f"the optimum is the corner (1, 1), the optimizer stayed at {reached:.3g}"

    def test_a_problem_alone_and_all_diverged(self, optimizer: Optimizer) -> None:
        guess = torch.tensor([[[0.3, 0.6]]], dtype=torch.float64)
        found = optimizer.minimize(Problems(all_nan, guess[:, 0]), guess, seed=1)
        assert torch.equal(found.best, guess[:, 0]), "where every candidate diverges, the first guess stands"
        assert bool(found.loss.isinf().all()), "where every candidate diverges, the loss is infinity"
        assert found.diverged.tolist() == [optimizer.evaluations()], "every diverged candidate is counted"
        assert found.spread.tolist() == [0.0], "where every candidate diverges, nothing tells candidates apart"

    @pytest.mark.parametrize("seed", [0, 7])
    def test_the_same_seed_gives_the_same_result(self, optimizer: Optimizer, seed: int) -> None:
        traits = _random(3, 2, seed=5)
        torch.manual_seed(1)
        one = _solve(optimizer, Problems(rugged, traits), n=2, seed=seed)
        torch.manual_seed(2)
        before = torch.get_rng_state()
        two = _solve(optimizer, Problems(rugged, traits), n=2, seed=seed)
        assert torch.equal(one.best, two.best), f"seed={seed} twice gave two results: randomness must come from `seed` alone"
        assert torch.equal(torch.get_rng_state(), before), "the global random state must be left alone"

    @pytest.mark.parametrize("function", [distance, bowl, some_nan])
    def test_problems_are_independent(self, optimizer: Optimizer, function: Function) -> None:
        traits, guesses = _random(10, 3, seed=5), _random(10, 2, 3, seed=6)
        together = optimizer.minimize(Problems(function, traits), guesses, seed=1)
        alone = optimizer.minimize(Problems(function, traits[3:7]), guesses[3:7], seed=1)
        message = "a problem's result must not depend on the problems beside it: caches and chunks would change results"
        torch.testing.assert_close(alone.loss, together.loss[3:7], rtol=1e-3, atol=1e-6, msg=message)
        torch.testing.assert_close(alone.best, together.best[3:7], rtol=1e-3, atol=1e-4, msg=message)

    def test_chunks_change_nothing(self, optimizer: Optimizer) -> None:
        problems, guesses = Problems(distance, _random(3, 2, seed=5)), _random(3, 1, 2, seed=6)
        whole = optimizer.minimize(problems, guesses, seed=1)
        pieces = optimizer.minimize(problems, guesses, seed=1, memory=1)
        message = "the memory bound decides on how many problems are solved at once, never on the result"
        torch.testing.assert_close(pieces.best, whole.best, rtol=1e-3, atol=1e-4, msg=message)
        torch.testing.assert_close(pieces.filling, whole.filling, msg=message)

    def test_evaluates_exactly_what_it_says(self, optimizer: Optimizer) -> None:
        problems, guesses = Problems(distance, _random(3, 2, seed=5)), _random(3, 2, 2, seed=6)
        done: list[int] = []
        optimizer.minimize(problems, guesses, seed=1, progress=done.append)
        asked = torch.cat(problems.asked, dim=1)
        assert asked.shape[1] == optimizer.evaluations(), "evaluations() is the budget of comparisons: not one more, not one less"
        assert sum(done) == 3 * optimizer.evaluations(), "progress must sum to problems times evaluations"
        for k in range(2):
            tried = (asked == guesses[:, k : k + 1]).all(dim=-1).any(dim=1)
            assert bool(tried.all()), "every guess is evaluated, and counts as an evaluation"

    def test_says_how_many_evaluations_fill_the_space(self, optimizer: Optimizer) -> None:
        assert 1 <= optimizer.space_filling() <= optimizer.evaluations(), "the spread is measured over the first evaluations"
        found = _solve(optimizer, Problems(distance, _random(3, 2, seed=5)), n=2, guesses=1)
        low, median, high = found.filling.unbind(1)
        assert bool((low <= median).all() and (median <= high).all()), "filling holds the lowest, median and highest loss"
        assert bool((found.spread > 0).all()), "where the choice of parameters matters, the spread is positive"

    @pytest.mark.parametrize("function", [flat, zero])
    def test_ties_go_to_the_first_guess(self, optimizer: Optimizer, function: Function) -> None:
        guesses = _random(3, 2, 2, seed=6)
        found = optimizer.minimize(Problems(function, guesses[:, 0]), guesses, seed=1)
        assert torch.equal(found.best, guesses[:, 0]), "a window that says nothing about the parameters keeps the first guess"
        assert found.spread.tolist() == [0.0] * 3, "a window that says nothing about the parameters has no spread"

    def test_returns_the_loss_of_what_it_returns(self, optimizer: Optimizer) -> None:
        problems, guesses = Problems(bowl, _random(4, 3, seed=5)), _random(4, 2, 3, seed=6)
        found = optimizer.minimize(problems, guesses, seed=1)
        torch.testing.assert_close(problems(found.best[:, None])[:, 0], found.loss, msg="`loss` must be the loss of `best`")
        assert bool((found.loss <= problems(guesses).amin(dim=1) * (1 + 1e-5)).all()), "the result is worse than a guess"


def _solve(optimizer: Optimizer, problems: Objective, *, n: int, guesses: int = 1, seed: int = 1) -> Solution:
    return optimizer.minimize(problems, _random(problems.problems, guesses, n, seed=99), seed=seed)


def _random(*shape: int, seed: int) -> Tensor:
    """Returns numbers in [0, 1)."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
