"""A population of drivers is found again from recordings that say little of each of them."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from cfx.core.progress import Task
from cfx.models.krauss import Krauss
from cfx_posteriors import population
from cfx_posteriors.chains import Chains
from cfx_posteriors.density import Posterior
from cfx_posteriors.importance import sample
from cfx_posteriors.intervals import SAMPLES
from cfx_posteriors.laplace import Normal, laplace
from cfx_posteriors.population import CHAINS, Population, fit_population

from .recordings import draw_recordings

SPACE = Krauss().space
TRUE = Population(
    SPACE,
    torch.tensor([[0.5, -1.0]], dtype=torch.float64),
    torch.tensor([[[0.30, 0.18], [0.18, 0.20]]], dtype=torch.float64),
)
SHARES = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
DRIVERS, FEW = 60, 6
MEMORY = 1 << 30


class Fitted(NamedTuple):
    """A population of drivers `(P, n)`, and what is said of each."""

    truth: Tensor
    alone: Normal
    population: Population
    likeliest: Tensor
    within: Chains


def laplace_of(posterior: Posterior) -> Normal:
    assert posterior.prior.center is not None
    return laplace(posterior, posterior.prior.center.expand(posterior.segments.problems, 1, -1))


def draw(posterior: Posterior, normal: Normal) -> Tensor:
    settings = {"seed": 0, "memory": MEMORY, "draws": SAMPLES}
    return sample(posterior, normal, SHARES, **settings, apart=True).draws


def fitted(posterior: Posterior, truth: Tensor) -> Fitted:
    alone = laplace_of(posterior)
    of_all = fit_population(posterior, alone, draw, SHARES, seed=0, memory=MEMORY)
    return Fitted(truth[:, : len(SPACE)], alone, *of_all)


@pytest.fixture(scope="module")
def whole() -> Fitted:
    drawn = draw_recordings(Krauss(), DRIVERS, frames=600, population=TRUE)
    return fitted(drawn.posterior, drawn.truth)


def test_mean_and_covariance_are_found_and_drivers_are_nearer_to_the_truth(whole: Fitted) -> None:
    middle = whole.population.middle
    assert middle.center is not None
    torch.testing.assert_close(middle.center, TRUE.mean[0], atol=0.15, rtol=0)
    covariance = torch.linalg.inv(middle.precision)
    torch.testing.assert_close(covariance, TRUE.covariance[0], atol=0.15, rtol=0)
    error = (whole.likeliest[:, :2] - whole.truth).square().mean()
    assert float(error) < float((whole.alone.mode[:, :2] - whole.truth).square().mean())


def test_intervals_of_mean_scatter_and_drivers_hold_the_truth(whole: Fitted) -> None:
    low, _, high = whole.within.quantiles.unbind(1)
    held = (low <= whole.truth) & (whole.truth <= high)
    assert 0.82 < float(held.double().mean()) < 0.97
    ends = torch.tensor([0.005, 0.995], dtype=torch.float64)
    for draws, true in (
        (whole.population.mean, TRUE.mean[0]),
        (whole.population.covariance.flatten(1), TRUE.covariance[0].flatten()),
    ):
        least, most = draws.quantile(ends, dim=0)
        assert bool(((least < true) & (true < most)).all())
    below = (whole.within.draws[..., :2] < whole.truth[:, None]).double().mean(1)
    assert whole.within.draws.shape == (DRIVERS, 100 * CHAINS, 4)
    assert float((whole.within.diagnostics["r_hat"] < 1.05).double().mean()) > 0.9
    assert bool((below[~held] < 0.08).logical_or(below[~held] > 0.92).all())


def test_fewer_drivers_say_less_of_the_population(whole: Fitted) -> None:
    drawn = draw_recordings(Krauss(), DRIVERS, frames=600, population=TRUE)
    few = fitted(drawn.posterior.take(torch.arange(FEW)), drawn.truth[:FEW]).population
    assert bool((few.mean.std(0) > 2.0 * whole.population.mean.std(0)).all())


class Unheard(Krauss):
    """Recordings of it say nothing."""

    likelihood_power = 0.0


def test_without_recordings_deviations_are_half_t_and_correlations_uniform() -> None:
    # Whatever moves drivers and populations, together or apart, leaves what is known a priori.
    drawn = draw_recordings(Unheard(), 3, frames=60)
    alone = drawn.posterior
    samples = draw(alone, laplace_of(alone))[..., :-1]
    walk = population._Walk(alone, alone, samples, seed=0, memory=MEMORY)
    task = Task("Sampling", 0)
    walk.go_on(200, task, learning=True)
    kept = [state for _ in range(2) for state in walk.go_on(600, task)]
    covariance = torch.cat([state.covariance for state in kept])
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    prior = torch.linalg.inv(alone.prior.precision).diagonal().sqrt()
    # Half of a t distribution with 2 degrees of freedom is within 0.8165, a quarter within 0.3652.
    shares = torch.tensor([0.25, 0.5], dtype=torch.float64)
    expected = torch.tensor([0.3652, 0.8165]).double()[:, None] * prior
    torch.testing.assert_close(deviation.quantile(shares, dim=0), expected, rtol=0.15, atol=0)
    correlation = covariance[:, 0, 1] / deviation.prod(1)
    quartiles = correlation.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
    assert quartiles.tolist() == pytest.approx([-0.5, 0.0, 0.5], abs=0.1)
    mean = torch.cat([state.mean for state in kept])
    assert alone.prior.center is not None
    torch.testing.assert_close(mean.mean(0), alone.prior.center, atol=0.2, rtol=0)
    torch.testing.assert_close(mean.std(0), prior, rtol=0.1, atol=0)


def test_drawn_drivers_are_as_correlated_as_the_population_and_within_bounds() -> None:
    drawn = TRUE.draw(4000, seed=1)
    low, high = SPACE.bounds().unbind(0)
    assert bool(((drawn > low) & (drawn < high)).all())
    logits = torch.logit(SPACE.to_unit(drawn))
    torch.testing.assert_close(torch.cov(logits.mT), TRUE.covariance[0], atol=0.03, rtol=0)
    torch.testing.assert_close(TRUE.draw(5, seed=2), TRUE.draw(5, seed=2), rtol=0, atol=0)


def test_new_drivers_differ_by_the_mean_that_is_not_known_too() -> None:
    apart = torch.tensor([[-2.0, -2.0], [2.0, 2.0]], dtype=torch.float64)
    narrow = 0.01 * torch.eye(2, dtype=torch.float64).expand(2, -1, -1)
    logits = torch.logit(SPACE.to_unit(Population(SPACE, apart, narrow).draw(1000, seed=0)))
    assert float((logits[:, 0] > 0).double().mean()) == pytest.approx(0.5, abs=0.06)
    assert float(logits.abs().min()) > 1.0
