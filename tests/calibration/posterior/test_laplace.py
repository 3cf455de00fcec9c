"""Laplace's approximation: mode, marginals, and whether intervals hold what they promise."""

from __future__ import annotations

import math
from typing import Literal

import pytest
import torch

from cfx.calibration.posterior import noise
from cfx.calibration.posterior.density import ParameterPrior
from cfx.calibration.posterior.laplace import laplace, marginal_quantiles
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from tests.calibration.posterior.recordings import Drawn, draw_recordings

SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)


def found_by_default(drawn: Drawn) -> torch.Tensor:
    """Returns the ranks of true parameters among 20 classes that are equally likely."""
    posterior = drawn.posterior
    assert posterior.prior.center is not None
    n = len(posterior.space)
    starts = posterior.prior.center.expand(len(drawn.truth), 1, n)
    normal = laplace(posterior, starts)
    quantiles = marginal_quantiles(posterior, normal, SHARES)
    return (drawn.truth[:, None, :n] > quantiles).sum(1)


@pytest.mark.parametrize(("model", "signal"), [(Krauss(), "speed"), (IDM(), "gap")])
def test_intervals_hold_the_truth_as_often_as_they_say(
    model: DrivingModel, signal: Literal["speed", "gap"]
) -> None:
    ranks = found_by_default(draw_recordings(model, 150, signal=signal))
    inside = ((ranks > 0) & (ranks < 19)).double().mean()
    assert 0.85 < float(inside) < 0.95


def test_ranks_of_true_parameters_are_uniform() -> None:
    """The rank of the truth, in four classes: chi-squared is below its 99.9 % point."""
    ranks = found_by_default(draw_recordings(Krauss(), 150, seed=1))
    for column in range(ranks.shape[1]):
        counts = torch.histc(ranks[:, column].double(), 4, 0, 20)
        wanted = len(ranks) / 4
        assert float(((counts - wanted).square() / wanted).sum()) < 16.3


def test_the_mode_is_higher_than_anything_near_it() -> None:
    drawn = draw_recordings(Krauss(), 8)
    assert drawn.posterior.prior.center is not None
    normal = laplace(drawn.posterior, drawn.posterior.prior.center.expand(8, 1, -1))
    assert bool(normal.settled.all())
    directions = torch.randn((8, 32, 4), generator=torch.Generator().manual_seed(0)).double()
    factor = torch.linalg.cholesky(normal.covariance)
    near = normal.mode[:, None] + 0.2 * directions @ factor.mT
    assert float((drawn.posterior(near) - normal.log_density[:, None]).max()) < 0.05


def test_a_longer_recording_leaves_less_doubt() -> None:
    widths = []
    for frames in (150, 1200):
        drawn = draw_recordings(Krauss(), 20, frames=frames)
        assert drawn.posterior.prior.center is not None
        normal = laplace(drawn.posterior, drawn.posterior.prior.center.expand(20, 1, -1))
        quantiles = marginal_quantiles(drawn.posterior, normal, SHARES[[0, -1]])
        widths.append(float((quantiles[:, 1] - quantiles[:, 0]).median()))
    assert widths[1] < 0.6 * widths[0]


def test_the_density_of_noise_is_that_of_its_innovations() -> None:
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn((40, 2), generator=generator).double()
    counted = torch.ones_like(errors)
    counted[30:, 1] = 0.0
    errors = errors * counted
    squashed = torch.tensor([[0.8, -0.3], [0.1, 0.4]], dtype=torch.float64)
    log_scale = torch.tensor([[-0.2], [0.3]], dtype=torch.float64)
    products = noise.lagged_products(errors, counted, 2)
    found = noise.log_density(products, counted.sum(0), torch.cat([squashed, log_scale], dim=1))
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
        assert float(found[column]) == pytest.approx(wanted, rel=1e-12)


def test_without_a_prior_parameters_are_uniform_between_their_bounds() -> None:
    prior = ParameterPrior.of(Krauss().space, "none")
    places = torch.linspace(-30, 30, 20_001, dtype=torch.float64)
    density = prior.log_density(places[:, None, None])[:, 0].exp()
    below = torch.cumulative_trapezoid(density, places)
    share = torch.sigmoid(places[1:])
    torch.testing.assert_close(below / below[-1], share, atol=1e-4, rtol=0)
    quantiles = prior.quantiles(torch.tensor([0.1, 0.9], dtype=torch.float64), 2)
    torch.testing.assert_close(torch.sigmoid(quantiles[:, 0]), torch.tensor([0.1, 0.9]).double())
