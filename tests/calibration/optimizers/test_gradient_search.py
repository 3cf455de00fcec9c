from __future__ import annotations

from typing import Any

import pytest
import torch
from pydantic import ValidationError
from scipy.optimize import minimize
from torch import Tensor

from cfx.calibration.gradient_search import GradientSearch, _stages
from cfx.calibration.random_search import RandomSearch
from cfx.errors import ConfigError
from cfx_contracts import check_contract
from cfx_contracts.optimizers import Problems, bowl, distance


@pytest.mark.parametrize("options", [{}, {"samples": 300, "starts": 1, "screening": 0.1}])
def test_contract_with_optima_found_to_a_thousandth(options: dict[str, Any]) -> None:
    check_contract(GradientSearch(**{"samples": 512, **options}), tolerance=1e-3)


def valley(candidates: Tensor, optima: Tensor) -> Tensor:
    """Rosenbrock's function around each optimum: a bent valley, ten times as long as wide."""
    x, y = (4.0 * (candidates - optima)).unbind(-1)
    return x.square() + 100.0 * (y - x.square()).square()


def centre(problems: int, n: int) -> Tensor:
    return torch.full((problems, 1, n), 0.5, dtype=torch.float64)


def test_a_bent_valley_is_followed_to_its_end_as_scipys_search_does() -> None:
    optima = 0.2 + 0.6 * torch.rand(
        (20, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    found = GradientSearch(samples=1500, starts=1, screening=0.02).minimize(
        Problems(valley, optima), centre(20, 2), seed=0
    )
    theirs = []
    for optimum in optima:

        def loss(point: list[float], at: Tensor = optimum) -> float:
            return float(valley(torch.tensor(point, dtype=torch.float64), at))

        theirs.append(minimize(loss, [0.5, 0.5], bounds=[(0, 1)] * 2, method="L-BFGS-B").fun)
    assert float(found.loss.max()) < max(1e-7, 10 * max(theirs))


def test_an_optimum_on_the_bounds_is_found_there() -> None:
    outside = torch.tensor([[-0.3, 0.4, 1.5], [0.5, -1.0, 0.5]], dtype=torch.float64)
    found = GradientSearch(samples=600).minimize(Problems(bowl, outside), centre(2, 3), seed=0)
    torch.testing.assert_close(found.best, outside.clamp(0.0, 1.0), atol=2e-3, rtol=0)


def test_it_finds_more_than_random_search_with_as_many_evaluations() -> None:
    optima = torch.rand((10, 6), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    problems, guesses = Problems(distance, optima), centre(10, 6)
    walked = GradientSearch(samples=1024).minimize(problems, guesses, seed=0).loss
    searched = RandomSearch(samples=1024).minimize(problems, guesses, seed=0).loss
    assert bool((walked < 0.1 * searched).all())


def test_a_search_beside_candidates_that_diverge_goes_on() -> None:
    def half(candidates: Tensor, optima: Tensor) -> Tensor:
        loss = bowl(candidates, optima)
        return loss.where(candidates[..., 0] < 0.6, torch.nan)

    optima = torch.tensor([[0.55, 0.3], [0.2, 0.7]], dtype=torch.float64)
    found = GradientSearch(samples=600).minimize(Problems(half, optima), centre(2, 2), seed=0)
    torch.testing.assert_close(found.best, optima, atol=1e-3, rtol=0)
    assert bool((found.diverged > 0).all())


def test_too_few_samples_to_choose_starts_is_told() -> None:
    with pytest.raises(ConfigError, match=r"optimizer\.starts=4: only 3 samples choose"):
        GradientSearch(samples=4, starts=4)


def test_more_samples_reach_a_lower_of_many_minima() -> None:
    def wavy(candidates: Tensor, optima: Tensor) -> Tensor:
        away = candidates - optima
        return (away**2 + 0.05 * (1.0 - torch.cos(60.0 * away))).sum(-1)

    optima = torch.rand((10, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    problems, guesses = Problems(wavy, optima), centre(10, 3)
    few = GradientSearch(samples=512).minimize(problems, guesses, seed=0).loss
    many = GradientSearch(samples=16384).minimize(problems, guesses, seed=0).loss
    one = GradientSearch(samples=16384, starts=1).minimize(problems, guesses, seed=0).loss
    assert float(many.mean()) < 0.1 * float(few.mean())
    assert float(many.mean()) < 0.5 * float(one.mean())


def test_settings_alone_say_so_too() -> None:
    with pytest.raises(ValidationError):
        GradientSearch.schema(samples=0)


@pytest.mark.parametrize("searches", [1, 3, 4, 9])
def test_stages_use_as_many_samples_as_there_are(searches: int) -> None:
    stages, rest = _stages(searches, 1000, 11)
    used = sum(count * rounds * 11 for count, rounds in stages)
    assert used + rest == 1000
    assert rest < stages[-1][0] * 11
    assert stages[0][0] == searches
