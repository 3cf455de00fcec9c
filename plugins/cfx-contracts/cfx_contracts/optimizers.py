"""The contract of an optimizer, statement by statement.

Shapes as in `cfx.calibration.optimizers`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from cfx.calibration.contract import FIRST_OF_OPTIMIZERS
from cfx.calibration.optimizers import CandidateLosses, Optimizer, Solution
from cfx.core.contract import NotApplicable, expect_close
from cfx.errors import PluginError
from cfx_contracts import contract_of

Function = Callable[[Tensor, Tensor], Tensor]
"""Losses `(P, q)` of candidates `(P, q, n)`, given what tells problems apart, `(P, n)`."""


TOLERANCE = 0.05
"""How far in unit space from a known optimum of two parameters an optimizer may end."""


class Problems:
    """P functions as an objective, which remembers what it was asked."""

    def __init__(
        self, function: Function, optima: Tensor, asked: list[Tensor] | None = None
    ) -> None:
        self._function = function
        self._optima = optima
        self.asked: list[Tensor] = []
        if asked is not None:
            self.asked = asked

    @property
    def problems(self) -> int:
        """P."""
        return len(self._optima)

    def __call__(self, candidates: Tensor) -> Tensor:
        assert candidates.shape[0] == self.problems, (
            "an objective is asked about all its problems at once"
        )
        self.asked.append(candidates.detach().clone())
        return self._function(candidates, self._optima[:, None])

    def take(self, problems: slice | Tensor) -> Problems:
        """Returns some of the problems; what they are asked is remembered here."""
        return Problems(self._function, self._optima[problems], self.asked)

    def rough(self) -> Problems:
        """Returns itself."""
        return self


def distance(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns the distance to the optimum: a kink there, as an RMSE has."""
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


def recovers_a_known_optimum(optimizer: Optimizer, tolerance: float = TOLERANCE) -> None:
    optima = _random(8, 2, seed=11)
    for function in (distance, bowl):
        solution = _solve(optimizer, Problems(function, optima), n=2)
        worst = torch.linalg.vector_norm(solution.best - optima, dim=-1).max().item()
        assert worst <= tolerance, (
            f"the optimum of a smooth function of two parameters must be found to {tolerance:g} in"
            " unit space, or calibration says nothing about the driver;"
            f" '{function.__name__}' was missed by {worst:.3g}"
        )


def never_leaves_the_bounds(optimizer: Optimizer) -> None:
    for n, guesses, seed in ((1, 1, 0), (2, 3, 1), (3, 1, 1000), (5, 2, 7)):
        problems = Problems(rugged, 1.5 * _random(16, n, seed=seed) - 0.25)
        try:
            solution = _solve(optimizer, problems, n=n, guesses=guesses, seed=seed)
        except PluginError as error:
            raise AssertionError(
                f"{error}: a model would drive with parameters outside its bounds"
            ) from error
        for candidates in [*problems.asked, solution.best]:
            inside = bool(((candidates >= 0) & (candidates <= 1)).all())
            assert inside, (
                "a candidate lies outside [0, 1]: a model would drive with parameters outside its"
                " bounds"
            )


def survives_whatever_the_losses_are(optimizer: Optimizer) -> None:
    for function in (flat, zero, some_nan, some_infinite, all_nan, steps, enormous, corner):
        for n in (1, 3):
            solution = _solve(optimizer, Problems(function, _random(2, n, seed=5)), n=n)
            what = f" ('{function.__name__}' of {n} parameters)"
            assert bool(solution.best.isfinite().all()), (
                f"the parameters of a window must be numbers whatever its losses are{what}"
            )
            assert not bool(solution.loss.isnan().any()), (
                "a loss is a number, or infinity where every candidate diverged, for means are"
                f" taken over losses{what}"
            )


def survives_duplicate_guesses(optimizer: Optimizer) -> None:
    optima = _random(3, 2, seed=5)
    guesses = optima[:, None].expand(-1, 3, -1)
    solution = optimizer.minimize(Problems(distance, optima), guesses, seed=1)
    expect_close(
        solution.best,
        optima,
        msg="the guesses were the optimum, so it must be returned: what was evaluated and what is"
        " returned are the same numbers",
    )


def finds_a_corner(optimizer: Optimizer, tolerance: float = TOLERANCE) -> None:
    solution = _solve(optimizer, Problems(corner, _random(3, 2, seed=5)), n=2)
    reached = solution.best.min().item()
    assert reached >= 1 - 2 * tolerance, (
        "the best parameters of real drivers often lie at a bound, so the bounds must be within"
        f" reach; the optimum is the corner (1, 1), the optimizer stayed at {reached:.3g}"
    )


def a_problem_alone_and_all_diverged(optimizer: Optimizer) -> None:
    guess = torch.tensor([[[0.3, 0.6]]], dtype=torch.float64)
    solution = optimizer.minimize(Problems(all_nan, guess[:, 0]), guess, seed=1)
    assert torch.equal(solution.best, guess[:, 0]), (
        "where every candidate diverges, the first guess stands: a window needs some parameters"
    )
    assert bool(solution.loss.isinf().all()), (
        "where every candidate diverges, the loss is infinity: nobody may take it for a result"
    )
    assert solution.diverged.tolist() == [optimizer.returned(2)], (
        "every diverged candidate is counted: users see which models fail within their bounds"
    )
    assert solution.sensitivity.tolist() == [0.0], (
        "where every candidate diverges, nothing tells candidates apart: such a window must weigh"
        " nothing"
    )


def the_same_seed_gives_the_same_result(optimizer: Optimizer) -> None:
    optima = _random(3, 2, seed=5)
    for seed in (0, 7):
        with _kept_random_states():
            _set_random_states(1)
            first = _solve(optimizer, Problems(rugged, optima), n=2, seed=seed)
            _set_random_states(2)
            before = _random_states()
            second = _solve(optimizer, Problems(rugged, optima), n=2, seed=seed)
            after = _random_states()
        assert torch.equal(first.best, second.best), (
            f"seed={seed} twice gave two results: randomness must come from `seed` alone, or no"
            " result can be repeated"
        )
        for name, state in before.items():
            assert state == after[name], (
                f"the global random state of {name} must be left alone: others draw from it"
            )


def another_seed_searches_elsewhere(optimizer: Optimizer) -> None:
    by_seed = []
    for seed in (0, 7):
        problems = Problems(rugged, _random(3, 2, seed=5))
        _solve(optimizer, problems, n=2, seed=seed)
        by_seed.append(torch.cat([candidates.flatten() for candidates in problems.asked]))
    if optimizer.evaluations(3) == 1:
        raise NotApplicable("only the first guess is evaluated")
    assert not torch.equal(*by_seed), (
        "seeds 0 and 7 asked for the same candidates: `seed` must reach the search, or repeating a"
        " study with other seeds shows less variation than there is"
    )


def problems_are_independent(optimizer: Optimizer) -> None:
    optima, guesses = _random(10, 3, seed=5), _random(10, 2, 3, seed=6)
    message = (
        "a problem's result must not depend on the problems beside it: caches and shards would"
        " change results"
    )
    for function in (distance, bowl, some_nan):
        together = optimizer.minimize(Problems(function, optima), guesses, seed=1)
        alone = optimizer.minimize(Problems(function, optima[3:7]), guesses[3:7], seed=1)
        expect_close(alone.loss, together.loss[3:7], rtol=1e-3, atol=1e-6, msg=message)
        expect_close(alone.best, together.best[3:7], rtol=1e-3, atol=1e-4, msg=message)


def shards_change_nothing(optimizer: Optimizer) -> None:
    problems, guesses = Problems(distance, _random(3, 2, seed=5)), _random(3, 1, 2, seed=6)
    whole = optimizer.minimize(problems, guesses, seed=1)
    pieces = optimizer.minimize(problems, guesses, seed=1, memory=1)
    message = (
        "the memory bound decides on how many problems are solved at once, never on the result"
    )
    expect_close(pieces.best, whole.best, rtol=1e-3, atol=1e-4, msg=message)
    expect_close(pieces.filling, whole.filling, msg=message)


def evaluates_exactly_what_it_says(optimizer: Optimizer) -> None:
    problems, guesses = Problems(distance, _random(3, 2, seed=5)), _random(3, 2, 2, seed=6)
    done: list[int] = []
    optimizer.minimize(problems, guesses, seed=1, progress=done.append)
    count = sum(candidates.shape[0] * candidates.shape[1] for candidates in problems.asked)
    assert 3 * optimizer.returned(2) <= count <= 3 * optimizer.evaluations(2), (
        "evaluations(n) is the budget of comparisons: a search may end early, and evaluates what it"
        " returns"
    )
    assert sum(done) == 3 * optimizer.evaluations(2), (
        "progress must sum to problems times evaluations: users wait by it"
    )
    # A search that goes on with some of the problems has evaluated the guesses of all before.
    together = [candidates for candidates in problems.asked if len(candidates) == problems.problems]
    for k in range(2):
        tried = (torch.cat(together, dim=1) == guesses[:, k : k + 1]).all(dim=-1).any(dim=1)
        assert bool(tried.all()), (
            "every guess is evaluated, and counts as an evaluation: no result may be worse than"
            " what was known before"
        )


def measures_the_sensitivity_where_parameters_matter(optimizer: Optimizer) -> None:
    solution = _solve(optimizer, Problems(distance, _random(3, 2, seed=5)), n=2, guesses=1)
    low, median, high = solution.filling.unbind(1)
    assert bool((low <= median).all() and (median <= high).all()), (
        "filling holds the lowest, median and highest loss"
    )
    assert bool((solution.sensitivity > 0).all()), (
        "where the choice of parameters matters, the sensitivity is positive"
    )


def ties_go_to_the_first_guess(optimizer: Optimizer) -> None:
    guesses = _random(3, 2, 2, seed=6)
    for function in (flat, zero):
        solution = optimizer.minimize(Problems(function, guesses[:, 0]), guesses, seed=1)
        assert torch.equal(solution.best, guesses[:, 0]), (
            "a window that says nothing about the parameters keeps the first guess"
        )
        assert solution.sensitivity.tolist() == [0.0] * 3, (
            "a window that says nothing about the parameters has a sensitivity of 0"
        )


def returns_the_loss_of_what_it_returns(optimizer: Optimizer) -> None:
    problems, guesses = Problems(bowl, _random(4, 3, seed=5)), _random(4, 2, 3, seed=6)
    solution = optimizer.minimize(problems, guesses, seed=1)
    expect_close(
        problems(solution.best[:, None])[:, 0],
        solution.loss,
        msg="`loss` must be the loss of `best`: candidates and losses that are returned belong"
        " together",
    )
    assert bool((solution.loss <= problems(guesses).amin(dim=1) * (1 + 1e-5)).all()), (
        "the result is worse than a guess, which was evaluated too"
    )


def _solve(
    optimizer: Optimizer, problems: CandidateLosses, *, n: int, guesses: int = 1, seed: int = 1
) -> Solution:
    return optimizer.minimize(problems, _random(problems.problems, guesses, n, seed=99), seed=seed)


def _random(*shape: int, seed: int) -> Tensor:
    """Returns numbers in [0, 1)."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _random_states() -> dict[str, object]:
    # The global state is what is looked at.
    name, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "torch": torch.get_rng_state().tolist(),
        "numpy": (name, list(keys), *rest),
        "random": random.getstate(),
    }


def _set_random_states(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - as above
    random.seed(seed)


@contextmanager
def _kept_random_states() -> Iterator[None]:
    """Leaves the global random states as they were found."""
    ours, theirs = np.random.get_state(legacy=True), random.getstate()  # noqa: NPY002 - as above
    with torch.random.fork_rng(devices=[]):
        yield
    np.random.set_state(ours)  # noqa: NPY002 - as above
    random.setstate(theirs)


CONTRACT = contract_of(
    __name__,
    "optimizer",
    first=FIRST_OF_OPTIMIZERS,
    slow=[
        problems_are_independent,
        survives_whatever_the_losses_are,
        shards_change_nothing,
        another_seed_searches_elsewhere,
        recovers_a_known_optimum,
        never_leaves_the_bounds,
        the_same_seed_gives_the_same_result,
        ties_go_to_the_first_guess,
        finds_a_corner,
        measures_the_sensitivity_where_parameters_matter,
    ],
)
