from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import differential_evolution

from cfx.errors import ConfigError
from cfx_community.optimizers.differential_evolution import DifferentialEvolution
from cfx_contracts import check_contract
from cfx_contracts.optimizers import Problems


def test_contract_of_another_strategy() -> None:
    optimizer = DifferentialEvolution(
        population=10, generations=10, strategy="randtobest1exp", recombination=0.9
    )
    check_contract(optimizer, tolerance=0.15)


def random(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def bumpy(candidates: torch.Tensor, optimum: torch.Tensor) -> torch.Tensor:
    """Returns a bowl full of local minima (Rastrigin)."""
    away = candidates - optimum
    return (away.square() + 0.02 * (1 - torch.cos(25 * away))).sum(-1)


def test_every_problem_is_solved_as_scipy_solves_it_alone() -> None:
    optima = random(3, 2)
    optimizer = DifferentialEvolution(population=16, generations=20)
    problems = Problems(bumpy, optima)
    found = optimizer.minimize(problems, random(3, 1, 2), seed=4)
    start = problems.asked[0]
    for k in range(3):
        alone = differential_evolution(
            lambda x, k=k: bumpy(torch.from_numpy(x.T), optima[k]).numpy(),
            [(0, 1)] * 2,
            init=start[k].numpy(),
            maxiter=20,
            tol=0,
            atol=0,
            polish=False,
            vectorized=True,
            updating="deferred",
            rng=np.random.default_rng(4),
        )
        assert found.loss[k].item() == pytest.approx(alone.fun, rel=1e-12)


def test_it_gets_out_of_local_minima() -> None:
    optima = 0.2 + 0.6 * random(8, 3)
    optimizer = DifferentialEvolution(population=30, generations=60)
    found = optimizer.minimize(
        Problems(bumpy, optima), torch.full((8, 1, 3), 0.5, dtype=torch.float64), seed=0
    )
    assert float((found.best - optima).abs().max()) < 0.01


def test_every_generation_is_one_call_for_all_problems() -> None:
    problems = Problems(bumpy, random(5, 3))
    DifferentialEvolution(population=7, generations=4).minimize(problems, random(5, 2, 3), seed=0)
    assert [tuple(asked.shape) for asked in problems.asked] == [(5, 7, 3)] * 5


def test_an_interrupted_search_leaves_nothing_behind() -> None:
    calls = []

    def interrupted(candidates: torch.Tensor, optimum: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return bumpy(candidates, optimum)

    with pytest.raises(KeyboardInterrupt):
        DifferentialEvolution().minimize(
            Problems(interrupted, random(4, 2)), random(4, 1, 2), seed=0
        )
    again = DifferentialEvolution().minimize(Problems(bumpy, random(4, 2)), random(4, 1, 2), seed=0)
    assert bool(again.loss.isfinite().all())


def test_more_guesses_than_the_population_is_told() -> None:
    with pytest.raises(ConfigError, match=r"optimizer\.population=5: there are 6 first guesses"):
        DifferentialEvolution(population=5).minimize(
            Problems(bumpy, random(1, 2)), random(1, 6, 2), seed=0
        )


def test_the_mutation_weights_must_be_in_order() -> None:
    with pytest.raises(ConfigError, match="mutation_low"):
        DifferentialEvolution(mutation_low=1.2, mutation_high=0.5)
