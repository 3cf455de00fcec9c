"""Laplace's approximation, the density of noise, and the prior."""

from __future__ import annotations

import math

import pytest
import torch

from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx_posteriors import noise
from cfx_posteriors.density import ParameterPrior
from cfx_posteriors.laplace import laplace, likely_starts

from .recordings import draw_recordings


def test_the_mode_is_higher_than_anything_near_it() -> None:
    drawn = draw_recordings(Krauss(), 8)
    assert drawn.posterior.prior.center is not None
    normal = laplace(drawn.posterior, drawn.posterior.prior.center.expand(8, 1, -1))
    assert bool(normal.settled.all())
    directions = torch.randn((8, 32, 4), generator=torch.Generator().manual_seed(0)).double()
    factor = torch.linalg.cholesky(normal.covariance)
    near = normal.mode[:, None] + 0.2 * directions @ factor.mT
    assert float((drawn.posterior(near) - normal.log_density[:, None]).max()) < 0.05


def test_a_model_may_have_its_likelihood_count_less(monkeypatch: pytest.MonkeyPatch) -> None:
    posterior, truth, _ = draw_recordings(Krauss(), 4, frames=300)
    places = truth[:, None] + torch.linspace(-0.2, 0.2, 5, dtype=torch.float64)[:, None]

    def likelihood() -> torch.Tensor:
        prior = noise.prior_log_density(places[..., 2:]) + posterior.prior_log_density(places)
        return posterior(places) - prior

    whole = likelihood()
    monkeypatch.setattr(Krauss, "likelihood_power", 0.25)
    torch.testing.assert_close(likelihood(), 0.25 * whole)
    normal = laplace(posterior, truth[:, None, :2])
    assert bool(normal.settled.all())
    away = torch.randn((4, 32, 4), generator=torch.Generator().manual_seed(0)).double()
    near = normal.mode[:, None] + 0.2 * away @ torch.linalg.cholesky(normal.covariance).mT
    assert float((posterior(near) - normal.log_density[:, None]).max()) < 0.05


def test_searches_find_the_highest_mode_however_far_it_is() -> None:
    drawn = draw_recordings(IDM(), 100, signal="gap")
    normal = laplace(drawn.posterior, likely_starts(drawn.posterior, seed=0))
    from_truth = laplace(drawn.posterior, drawn.truth[:, None, :5])
    assert float((from_truth.log_density > normal.log_density + 0.5).double().mean()) < 0.02


def test_the_density_of_noise_is_that_of_its_innovations() -> None:
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn((40, 2), generator=generator).double()
    counted = torch.ones_like(errors)
    counted[30:, 1] = 0.0
    errors = errors * counted
    squashed = torch.tensor([[0.8, -0.3], [0.1, 0.4]], dtype=torch.float64)
    log_scale = torch.tensor([[-0.2], [0.3]], dtype=torch.float64)
    products = noise.lagged_products(errors, counted, 2)
    density = noise.log_density(products, counted.sum(0), torch.cat([squashed, log_scale], dim=1))
    partial = squashed.tanh()
    for column, count in ((0, 40), (1, 30)):
        first, second = partial[column].tolist()
        phi = (first - second * first, second)
        scale = math.exp(float(log_scale[column]))
        own = [0.0, 0.0, *errors[:, column].tolist()]
        wanted = -2.0 * noise.SHAPE * math.log(scale) - noise.RATE / scale**2
        wanted += math.log(1 - first**2) + math.log(1 - second**2)
        for t in range(2, count + 2):
            innovation = own[t] - phi[0] * own[t - 1] - phi[1] * own[t - 2]
            wanted += -math.log(scale) - 0.5 * (innovation / scale) ** 2
        assert float(density[column]) == pytest.approx(wanted, rel=1e-12)


def test_without_a_prior_parameters_are_uniform_between_their_bounds() -> None:
    prior = ParameterPrior.of(Krauss().space, "none")
    places = torch.linspace(-30, 30, 20_001, dtype=torch.float64)
    density = prior.log_density(places[:, None, None])[:, 0].exp()
    below = torch.cumulative_trapezoid(density, places)
    share = torch.sigmoid(places[1:])
    torch.testing.assert_close(below / below[-1], share, atol=1e-4, rtol=0)
    quantiles = prior.quantiles(torch.tensor([0.1, 0.9], dtype=torch.float64), 2)
    torch.testing.assert_close(torch.sigmoid(quantiles[:, 0]), torch.tensor([0.1, 0.9]).double())
