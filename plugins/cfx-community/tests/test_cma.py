from __future__ import annotations

import pytest
import torch

import cfx
from cfx.errors import ConfigError
from cfx_community.optimizers.cma_es import CmaOptimizer
from cfx_contracts import check_contract
from cfx_contracts.optimizers import Problems


def test_contract_of_a_population_that_does_not_divide_the_budget() -> None:
    optimizer = CmaOptimizer(samples=71, initial=3, population=9, sigma=0.4)
    check_contract(optimizer, tolerance=0.15)


def random(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def valley(candidates: torch.Tensor, optimum: torch.Tensor) -> torch.Tensor:
    """Returns a narrow valley across the axes.

    Only a search that learns its direction gets to the bottom.
    """
    away = candidates - optimum
    return away.sum(-1).square() + 1e-4 * away.square().sum(-1)


def test_it_learns_the_shape_of_the_problem() -> None:
    problems, guesses = (
        Problems(valley, 0.2 + 0.6 * random(6, 4)),
        torch.full((6, 1, 4), 0.5, dtype=torch.float64),
    )
    found = CmaOptimizer(samples=1500).minimize(problems, guesses, seed=0)
    searched = cfx.get("optimizer", "random")(samples=1500).minimize(problems, guesses, seed=0)
    assert found.loss.median() < 0.001 * searched.loss.median()


def test_a_search_that_ends_starts_again_somewhere_else() -> None:
    """A deep hole far from a shallow one that the first search falls into."""

    def holes(candidates: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        shallow, deep = ((candidates - at).square().sum(-1) for at in (0.85, 0.12))
        return torch.minimum(shallow, 3 * deep - 1)

    guess = torch.full((1, 1, 2), 0.85, dtype=torch.float64)
    once = CmaOptimizer(samples=100, initial=1, sigma=0.05).minimize(
        Problems(holes, guess[:, 0]), guess, seed=0
    )
    often = CmaOptimizer(samples=1500, initial=1, sigma=0.05).minimize(
        Problems(holes, guess[:, 0]), guess, seed=0
    )
    assert once.loss.item() == pytest.approx(0, abs=1e-6)
    assert often.loss.item() == pytest.approx(-1, abs=1e-6)


def test_every_generation_is_one_call_for_all_problems() -> None:
    problems = Problems(valley, random(5, 3))
    CmaOptimizer(samples=64, initial=8, population=7).minimize(problems, random(5, 1, 3), seed=0)
    assert [tuple(asked.shape) for asked in problems.asked] == [(5, 8, 3)] + [(5, 7, 3)] * 8


@pytest.mark.parametrize("samples", [1, 5])
def test_a_budget_smaller_than_the_first_evaluations_is_kept(samples: int) -> None:
    optimizer = CmaOptimizer(samples=samples, initial=8)
    problems = Problems(valley, random(2, 3))
    optimizer.minimize(problems, random(2, 1, 3), seed=0)
    assert sum(asked.shape[1] for asked in problems.asked) == samples == optimizer.space_filling(3)


def test_more_guesses_than_first_evaluations_is_told() -> None:
    with pytest.raises(ConfigError, match=r"there are 3 first guesses; set optimizer\.initial"):
        CmaOptimizer(initial=2).minimize(Problems(valley, random(1, 2)), random(1, 3, 2), seed=0)
