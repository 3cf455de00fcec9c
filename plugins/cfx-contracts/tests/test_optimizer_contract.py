"""Each statement of the contract fails for an optimizer that breaks it, and says so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cfx.calibration import contract as first
from cfx.calibration.optimizers import CandidateLosses, Optimizer
from cfx.calibration.random_search import RandomSearch
from cfx.core.contract import violations
from cfx.errors import PluginError
from cfx_contracts import check_contract
from cfx_contracts import optimizers as checks

GOOD = RandomSearch(samples=4096)


class Small(RandomSearch):
    """Sixty evaluations, which a subclass spoils."""

    def __init__(self) -> None:
        super().__init__(samples=60)

    def draw(self, problems: int, count: int, n: int, seed: int) -> Tensor:
        return torch.rand(
            (count, n), generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        ).expand(problems, -1, -1)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        problems, g, n = guesses.shape
        candidates = torch.cat([guesses, self.draw(problems, 60 - g, n, seed)], dim=1)
        return candidates, objective(candidates)


class Straying(Small):
    def draw(self, *args: Any) -> Tensor:
        return 1.1 * super().draw(*args)


class Seedless(Small):
    def draw(self, problems: int, count: int, n: int, seed: int) -> Tensor:
        return super().draw(problems, count, n, 0)


class Global(Small):
    def draw(self, problems: int, count: int, n: int, seed: int) -> Tensor:
        return torch.rand((problems, count, n), dtype=torch.float64)


class SeedingNumpy(Small):
    def draw(self, problems: int, count: int, n: int, seed: int) -> Tensor:
        np.random.seed(seed)  # noqa: NPY002 - the mistake to be found
        return torch.from_numpy(np.random.rand(count, n)).expand(problems, -1, -1)  # noqa: NPY002 - as above


class Numbering(Small):
    """Draws other points in each shard."""

    def draw(self, problems: int, count: int, n: int, seed: int) -> Tensor:
        return super().draw(problems, count, n, seed + problems)


class Deaf(Small):
    """Does not look at the guesses."""

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        candidates = self.draw(len(guesses), 60, guesses.shape[2], seed).clone()
        return candidates, objective(candidates)


class Gossiping(Small):
    """Searches around the best candidate of all problems together."""

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        problems, g, n = guesses.shape
        first = torch.cat([guesses, self.draw(problems, 30 - g, n, seed)], dim=1)
        losses = objective(first)
        centre = first[:, losses.nan_to_num(posinf=1e9).mean(0).argmin()].mean(0)
        second = (centre + 0.1 * self.draw(problems, 30, n, seed)).clamp(0, 1)
        return torch.cat([first, second], dim=1), torch.cat([losses, objective(second)], dim=1)


class Lying(Small):
    def solve(self, *args: Any, **options: Any) -> tuple[Tensor, Tensor]:
        candidates, losses = super().solve(*args, **options)
        return candidates, 0.5 * losses


class Centring(Small):
    """Infinity minus infinity is no number."""

    def solve(self, *args: Any, **options: Any) -> tuple[Tensor, Tensor]:
        candidates, losses = super().solve(*args, **options)
        return candidates, losses - losses.mean(dim=1, keepdim=True)


class Hiding(Small):
    """Gives what diverged a number."""

    def solve(self, *args: Any, **options: Any) -> tuple[Tensor, Tensor]:
        candidates, losses = super().solve(*args, **options)
        return candidates, losses.nan_to_num(posinf=1e9)


class Shaking(Small):
    """Returns other candidates than it evaluated."""

    def solve(self, *args: Any, **options: Any) -> tuple[Tensor, Tensor]:
        candidates, losses = super().solve(*args, **options)
        return (candidates - 1e-3).clamp(0, 1), losses


class Half(Small):
    def draw(self, *args: Any) -> Tensor:
        return 0.5 * super().draw(*args)


class Overfilled(Small):
    def space_filling(self, n: int) -> int:
        return 61


class Frozen(Small):
    """Evaluates the first guess alone, again and again."""

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        candidates = guesses[:, :1].expand(-1, 60, -1)
        return candidates, objective(candidates)


class Twice(Small):
    """Evaluates everything twice."""

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        super().solve(objective, guesses, seed=seed)
        return super().solve(objective, guesses, seed=seed)


BROKEN: dict[str, tuple[Optimizer, Any, str]] = {
    "coarse": (Small(), checks.recovers_a_known_optimum, "was missed by"),
    "straying": (Straying(), checks.never_leaves_the_bounds, "outside"),
    "no number": (
        Centring(),
        checks.survives_whatever_the_losses_are,
        "losses that are numbers or infinity",
    ),
    "shaking": (Shaking(), checks.survives_duplicate_guesses, "it must be returned"),
    "half": (Half(), checks.finds_a_corner, "bounds must be within reach"),
    "hiding": (
        Hiding(),
        checks.a_problem_alone_and_all_diverged,
        "the loss is infinity|the first guess stands",
    ),
    "global": (Global(), checks.the_same_seed_gives_the_same_result, "two results"),
    "seeding numpy": (
        SeedingNumpy(),
        checks.the_same_seed_gives_the_same_result,
        "global random state of numpy",
    ),
    "seedless": (Seedless(), checks.another_seed_searches_elsewhere, "must reach the search"),
    "gossiping": (
        Gossiping(),
        checks.problems_are_independent,
        "must not depend on the problems beside it",
    ),
    "numbering": (Numbering(), checks.shards_change_nothing, "never on the result"),
    "deaf": (Deaf(), checks.evaluates_exactly_what_it_says, "every guess is evaluated"),
    "twice": (Twice(), checks.evaluates_exactly_what_it_says, "is the budget of comparisons"),
    "overfilled": (
        Overfilled(),
        first.says_how_much_it_does_in_whole_numbers,
        "measured over the first of what it",
    ),
    "frozen": (
        Frozen(),
        checks.measures_the_sensitivity_where_parameters_matter,
        "the sensitivity is positive",
    ),
    "deaf to ties": (Deaf(), checks.ties_go_to_the_first_guess, "keeps the first guess"),
    "lying": (Lying(), checks.returns_the_loss_of_what_it_returns, "loss of `best`"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    # A PluginError is the sentence with which `minimize` itself refuses what no calibration could
    # use.
    with pytest.raises((AssertionError, PluginError), match=sentence):
        check(component)


def test_every_statement_has_an_optimizer_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


def test_a_miscount_is_reported() -> None:
    class Miscounting(Small):
        def evaluations(self, n: int) -> int:
            return 59

    found = dict(violations(Miscounting(), checks.CONTRACT.quick))
    assert "solve must return candidates" in found["evaluates_exactly_what_it_says"]
    check_contract(GOOD)


def test_checks_leave_the_random_states_alone() -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()  # noqa: NPY002 - the global state is meant
    checks.the_same_seed_gives_the_same_result(GOOD)
    after = torch.get_rng_state(), np.random.get_state()[1].tolist()  # noqa: NPY002 - as above
    assert torch.equal(before[0], after[0])
    assert before[1] == after[1]
