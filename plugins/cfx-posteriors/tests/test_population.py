"""A population of drivers is found again from recordings that say little of each of them."""

from __future__ import annotations

import pytest
import torch

from cfx.models.krauss import Krauss
from cfx_posteriors.density import Posterior
from cfx_posteriors.importance import sample
from cfx_posteriors.laplace import Normal, laplace
from cfx_posteriors.population import Population, fit_population

from .recordings import draw_recordings

SPACE = Krauss().space
TRUE = Population(
    SPACE,
    torch.tensor([0.5, -1.0], dtype=torch.float64),
    torch.tensor([[0.30, 0.18], [0.18, 0.20]], dtype=torch.float64),
)


def test_mean_and_covariance_are_found_and_drivers_are_nearer_to_the_truth() -> None:
    drawn = draw_recordings(Krauss(), 60, frames=600, population=TRUE)
    weak = drawn.posterior
    assert weak.prior.center is not None
    starts = weak.prior.center.expand(60, 1, -1)

    def draw(posterior: Posterior, normal: Normal) -> torch.Tensor:
        half = torch.tensor([0.5], dtype=torch.float64)
        return sample(posterior, normal, half, seed=0, memory=1 << 30).draws

    population, within, normal = fit_population(weak, laplace(weak, starts), draw)
    torch.testing.assert_close(population.mean, TRUE.mean, atol=0.15, rtol=0)
    torch.testing.assert_close(population.covariance, TRUE.covariance, atol=0.15, rtol=0)
    assert within.prior.center is population.mean
    truth = drawn.truth[:, :2]
    alone = laplace(weak, starts).mode[:, :2]
    error = (normal.mode[:, :2] - truth).square().mean()
    assert float(error) < float((alone - truth).square().mean())


def test_drawn_drivers_are_as_correlated_as_the_population_and_within_bounds() -> None:
    drawn = TRUE.draw(4000, seed=1)
    low, high = SPACE.bounds().unbind(0)
    assert bool(((drawn > low) & (drawn < high)).all())
    logits = torch.logit(SPACE.to_unit(drawn))
    torch.testing.assert_close(torch.cov(logits.mT), TRUE.covariance, atol=0.03, rtol=0)
    torch.testing.assert_close(TRUE.draw(5, seed=2), TRUE.draw(5, seed=2), rtol=0, atol=0)
    assert TRUE.center.tolist() == pytest.approx(drawn.median(0).values.tolist(), rel=0.05)
