from __future__ import annotations

import pytest
import torch
from botorch.models import SingleTaskGP
from torch import Tensor

import cfx
from cfx.calibration import botorch
from cfx.calibration.botorch import BotorchOptimizer
from cfx.errors import ConfigError
from cfx_contracts.optimizers import Function, Problems, bowl, distance


@pytest.mark.parametrize("function", [distance, pytest.param(bowl, marks=pytest.mark.slow)])
def test_forty_evaluations_beat_four_thousand_random_ones(function: Function) -> None:
    optima = torch.rand(20, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    guesses = torch.full((20, 1, 2), 0.5, dtype=torch.float64)
    problems = Problems(function, optima)
    searched = cfx.get("optimizer", "random")(samples=4096).minimize(problems, guesses, seed=0)
    forty = BotorchOptimizer(screening=0)
    modelled = forty.minimize(problems, guesses, seed=0)
    assert forty.evaluations(2) == 40
    assert modelled.loss.mean() <= 1.02 * searched.loss.mean()


def test_marginals_are_those_of_botorchs_posterior() -> None:
    draw = torch.Generator().manual_seed(1)
    seen, query = (
        torch.rand(3, count, 4, generator=draw, dtype=torch.float64) for count in (12, 50)
    )
    values = torch.randn(3, 12, 1, generator=draw, dtype=torch.float64)
    kernel, mean = (
        botorch._kernel(4, torch.Size([3])).double(),
        botorch.ConstantMean(batch_shape=torch.Size([3])).double(),
    )
    process = botorch._MarginalGP(seen, values, mean, kernel)
    joint = SingleTaskGP(
        seen,
        values,
        torch.full_like(values, botorch._NOISE),
        mean_module=mean,
        covar_module=kernel,
        outcome_transform=None,
    )
    with torch.no_grad():
        marginal = botorch._Marginals(process).posterior(query.transpose(0, 1)[..., None, :])
        expected = joint.posterior(query)
    torch.testing.assert_close(marginal.mean[:, :, 0].transpose(0, 1), expected.mean)
    torch.testing.assert_close(
        marginal.variance[:, :, 0].transpose(0, 1), expected.variance, rtol=1e-6, atol=1e-9
    )


def test_modelled_values_keep_the_order_of_losses_and_are_finite() -> None:
    losses = torch.tensor(
        [
            [0.0, 1e-9, 0.1, 3.0],
            [-2.0, -1.0, 0.0, 5.0],
            [1e-300, 1.0, 1e308, torch.inf],
            [torch.inf] * 4,
            [0.0] * 4,
        ],
        dtype=torch.float64,
    )
    values = botorch._values(losses)
    assert bool(values.isfinite().all())
    assert bool((values.diff(dim=1) <= 0).all())


def test_a_process_begins_with_the_guesses_and_the_best_of_the_others() -> None:
    losses = torch.tensor([[9.0, 8.0, 3.0, 1.0, 2.0, 4.0], [0.0, 0.0, 1.0, 2.0, 3.0, 4.0]])
    assert botorch._best_of(losses, 2, 4).tolist() == [[0, 1, 3, 4], [0, 1, 2, 3]]


def test_screening_helps_in_ten_dimensions() -> None:
    optima = torch.rand(12, 10, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    guesses = torch.full((12, 1, 10), 0.5, dtype=torch.float64)
    problems = Problems(distance, optima)
    found = BotorchOptimizer(screening=500, iterations=5).minimize(problems, guesses, seed=0)
    searched = cfx.get("optimizer", "random")(samples=510).minimize(problems, guesses, seed=0)
    assert found.loss.mean() < searched.loss.mean()


def test_the_first_process_is_fitted_longer_and_later_ones_go_on_from_it() -> None:
    def candidates_of(**steps: int) -> Tensor:
        problems = Problems(distance, torch.tensor([[0.1, 0.7]], dtype=torch.float64))
        guesses = torch.full((1, 1, 2), 0.5, dtype=torch.float64)
        optimizer = BotorchOptimizer(screening=0, iterations=2, **steps)
        optimizer.minimize(problems, guesses, seed=0)
        return torch.cat([candidates[0] for candidates in problems.asked])

    usual = candidates_of(first_fit_steps=20, fit_steps=2)
    later = candidates_of(first_fit_steps=20, fit_steps=20)
    assert torch.equal(usual[:-1], later[:-1])
    assert not torch.equal(usual[-1], later[-1])
    assert not torch.equal(usual[-2], candidates_of(first_fit_steps=2, fit_steps=2)[-2])


def test_more_guesses_than_initial_evaluations_is_told() -> None:
    problems = Problems(distance, torch.rand(1, 2, dtype=torch.float64))
    with pytest.raises(ConfigError, match=r"optimizer\.initial=2: there are 3 first guesses"):
        BotorchOptimizer(initial=2).minimize(problems, torch.full((1, 3, 2), 0.5), seed=0)
