"""A population of drivers: parameters and noise of each, and how they are distributed among them.

Logits of drivers' parameters are normal among drivers. Mean and covariance are drawn, not found:
some drivers say little of them, least of what none of their recordings determines.

    mean ~ the prior of a driver without a population
    standard deviations among drivers ~ half t, 2 degrees of freedom, the prior's as its scale;
        correlations are uniform
    driver's logits ~ normal(mean, covariance)
    errors given the logits ~ autoregressive noise

The population is the prior of each driver: where their recording says little, they are like the
others. Drivers are drawn given mean and covariance, mean and covariance given drivers, in turn
(Gibbs): the latter by the hierarchy of inverse Wishart distributions of Huang and Wand, the former
among samples of each driver's posterior with some wider population, by the ratio of the two
populations' densities (Hogg, Myers and Bovy). Samples are made anew with what was drawn.

In place of them mean and covariance of highest density (expectation and maximisation) count as
known: 90 % intervals of IDM's desired speed held 74 to 76 %.

A. Huang and M. P. Wand (2013), *Simple marginally noninformative prior distributions for covariance
matrices*, Bayesian Analysis 8(2). D. W. Hogg, A. D. Myers and J. Bovy (2010), *Inferring the
eccentricity distribution*, The Astrophysical Journal 725.

Shapes: P drivers, q samples of each, n tuned parameters, d coordinates, R draws of the population.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.plugin import ParameterSpace
from cfx_posteriors.density import ParameterPrior, Posterior
from cfx_posteriors.importance import (
    DRAWS,
    Sampled,
    effective_size,
    systematic,
    weighted_quantiles,
)
from cfx_posteriors.laplace import Normal, laplace

SAMPLES = 1000
"""Of each driver's posterior with a wider population."""

_AMONG_SAMPLES = 250
"""Of these, among which a driver is drawn."""

_ROUNDS = (600, 4000)
"""Draws of the population with each set of samples. With 500 in place of 4,000 bounds of the
deviation of IDM's desired speed among 60 drivers, which recordings hardly tell, are up to 20 %
off."""

_FORGOTTEN = 0.25
"""Share of each round's draws that the start may have left its mark on."""

_EVERY = 8
"""Of so many draws of the population one is kept, and weighs all samples."""

_FREEDOM = 2.0
"""Degrees of freedom of the half t distributions: correlations are uniform then."""

_MOST = 0.9
"""Of the populations drawn, whose variances are exceeded by those that samples are made with: what
no recording determines has a variance that is hardly known, and the middle of such variances is far
below most."""

_WIDER = 2.0
"""By how much the population that samples are made with has larger variances than those drawn:
where samples are few, a population cannot come to be wide. With 1.5, and samples that were made
anew twice, intervals held 79 instead of 85 % of the parameters of 60 IDM drivers (30 s, errors of
the trajectory)."""

_QUANTILES_FROM = 20_000
"""New drivers that quantiles are taken from."""


@dataclass(frozen=True)
class Population:
    """How drivers' parameters are distributed, as far as it is known: logits are normal.

    Attributes:
        space: of the parameters.
        mean: of logits, equally likely draws, `(R, n)`.
        covariance: of logits among drivers, with each, `(R, n, n)`.
    """

    space: ParameterSpace
    mean: Tensor
    covariance: Tensor

    @property
    def middle(self) -> ParameterPrior:
        """The population in the middle of the draws: mean of means, and of inverse covariances."""
        return ParameterPrior(self.mean.mean(0), torch.linalg.inv(self.covariance).mean(0))

    def quantiles(self, shares: Tensor) -> Tensor:
        """Returns quantiles of new drivers' logits, `(len(shares), n)`."""
        logits = self._logits(_QUANTILES_FROM, torch.Generator().manual_seed(0))
        return logits.quantile(shares, dim=0)

    def draw(self, drivers: int, *, seed: int = 0) -> Tensor:
        """Returns parameters of new drivers, `(drivers, n)`, SI units, as correlated as theirs."""
        logits = self._logits(drivers, torch.Generator().manual_seed(seed))
        return self.space.from_unit(torch.sigmoid(logits))

    def _logits(self, drivers: int, generator: torch.Generator) -> Tensor:
        """Returns logits of new drivers, each of one of the draws, `(drivers, n)`."""
        which = torch.randint(len(self.mean), (drivers,), generator=generator)
        shape = (drivers, self.mean.shape[1], 1)
        normal = torch.randn(shape, generator=generator, dtype=torch.float64)
        factor = torch.linalg.cholesky(self.covariance)[which]
        logits: Tensor = self.mean[which] + (factor @ normal)[..., 0]
        return logits


def fit_population(
    posterior: Posterior,
    normal: Normal,
    draw: Callable[[Posterior, Normal], Sampled],
    shares: Tensor,
    *,
    seed: int,
) -> tuple[Population, Tensor, Sampled]:
    """Finds the population of drivers, and each driver's posterior within it.

    Args:
        posterior: of P drivers, with the prior that the model's bounds and defaults give.
        normal: Laplace's approximation of it.
        draw: samples of a posterior, given Laplace's approximation of it, with `SAMPLES` draws.
        shares: of the quantiles, within (0, 1).
        seed: the same seed gives the same population.

    Returns:
        The population, the drivers' likeliest coordinates within it, `(P, d)`, and their samples.
    """
    n = len(posterior.space)
    wide = posterior.prior
    if wide.center is not None:  # uniform between the bounds, all of it is wide
        wide = replace(wide, precision=wide.precision / _WIDER)
    mode = normal.mode
    for number, rounds in enumerate(_ROUNDS):
        within = replace(posterior, prior=wide)
        normal = laplace(within, mode[:, None, : posterior.simulated])
        sampled = draw(within, normal)
        generator = torch.Generator().manual_seed(seed + number)
        population, weights = _drawn(sampled.draws, within, posterior.prior, rounds, generator)
        mode, wide = normal.mode, _wider(population)
    within = replace(posterior, prior=population.middle)
    likeliest = laplace(within, mode[:, None, : posterior.simulated]).mode
    kept = effective_size(weights.log()) / weights.shape[1]
    of_drivers = sampled._replace(
        quantiles=weighted_quantiles(sampled.draws[..., :n], weights, shares),
        draws=systematic(sampled.draws, weights, DRAWS, [generator]),
        effective=kept * sampled.effective,
    )
    return population, likeliest, of_drivers


def _wider(population: Population) -> ParameterPrior:
    """Returns a population that is wider than most of those drawn, with their correlations."""
    middle = torch.linalg.inv(population.middle.precision)
    of_draws = population.covariance.diagonal(dim1=1, dim2=2)
    variances = of_draws.quantile(_MOST, dim=0) + population.mean.var(0)
    ratio = (_WIDER * variances / middle.diagonal()).sqrt()
    covariance = ratio[:, None] * middle * ratio
    return replace(population.middle, precision=torch.linalg.inv(covariance))


def _drawn(
    samples: Tensor,
    within: Posterior,
    prior: ParameterPrior,
    rounds: int,
    generator: torch.Generator,
) -> tuple[Population, Tensor]:
    """Returns draws of the population, and weights of each driver's samples over all of them.

    Args:
        samples: equally likely, of a wider population, `(P, q, d)`.
        within: the posterior that they are of.
        prior: of a driver without a population.
        rounds: draws.
        generator: of random numbers.

    Returns:
        The population, and weights that sum to 1, `(P, q)`.
    """
    n, drivers = len(within.space), torch.arange(len(samples))
    logits = samples[..., :n]
    every_density = within.prior.log_density(logits)
    few, density = logits[:, :_AMONG_SAMPLES].contiguous(), every_density[:, :_AMONG_SAMPLES]
    center = prior.quantiles(torch.tensor([0.5], dtype=torch.float64), n)[0]
    variances = torch.linalg.inv(prior.precision).diagonal()
    places = few[:, 0]
    mean, scales = places.mean(0), variances
    weights = torch.zeros_like(every_density)
    means, covariances = [], []
    for number in range(rounds):
        covariance, scales = _covariance(places - mean, scales, variances, generator)
        mean = _mean(places, covariance, center, variances, generator)
        ratios = _ratios(few, density, mean, covariance)
        place = torch.rand((len(samples), 1), generator=generator, dtype=torch.float64)
        which = torch.searchsorted(ratios.cumsum(dim=1), place)[:, 0]
        places = few[drivers, which.clamp(max=few.shape[1] - 1)]
        if number >= _FORGOTTEN * rounds and number % _EVERY == 0:
            weights += _ratios(logits, every_density, mean, covariance)
            means.append(mean)
            covariances.append(covariance)
    population = Population(within.space, torch.stack(means), torch.stack(covariances))
    return population, weights / len(means)


def _ratios(logits: Tensor, density: Tensor, mean: Tensor, covariance: Tensor) -> Tensor:
    """Returns weights of samples in a population, which sum to 1, `(P, q)`.

    Args:
        logits: of the samples, `(P, q, n)`.
        density: logarithm of that with which they were drawn, but for the recording's, `(P, q)`.
        mean, covariance: of the population.
    """
    likely = ParameterPrior(mean, torch.linalg.inv(covariance)).log_density(logits)
    return (likely - density).softmax(dim=1)


def _covariance(
    away: Tensor, scales: Tensor, variances: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Returns a covariance `(n, n)` given drivers' distances from the mean, and new scales.

    Args:
        away: `(P, n)`.
        scales: of the hierarchy, `(n,)`.
        variances: of the prior of a driver without a population, `(n,)`.
        generator: of random numbers.
    """
    drivers, n = away.shape
    scatter = away.mT @ away + torch.diag(2.0 * _FREEDOM / scales)
    precision = _wishart(_FREEDOM + n - 1 + drivers, torch.linalg.inv(scatter), generator)
    rate = _FREEDOM * precision.diagonal() + 1.0 / variances
    shape = torch.full_like(rate, 0.5 * (_FREEDOM + n))
    gamma = torch._standard_gamma(shape, generator=generator)  # noqa: SLF001 - the only one with a generator
    return torch.linalg.inv(precision), rate / gamma


def _wishart(freedom: float, scale: Tensor, generator: torch.Generator) -> Tensor:
    """Returns a draw of a Wishart distribution (Bartlett's decomposition), `(n, n)`."""
    n = len(scale)
    shape = 0.5 * (freedom - torch.arange(n, dtype=torch.float64))
    chi = 2.0 * torch._standard_gamma(shape, generator=generator)  # noqa: SLF001 - the only one with a generator
    lower = torch.randn((n, n), generator=generator, dtype=torch.float64).tril(-1)
    factor = torch.linalg.cholesky(scale) @ (lower + torch.diag(chi.sqrt()))
    drawn: Tensor = factor @ factor.mT
    return drawn


def _mean(
    places: Tensor,
    covariance: Tensor,
    center: Tensor,
    variances: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Returns a mean `(n,)` given drivers' logits `(P, n)` and their covariance.

    Args:
        places, covariance: as above.
        center, variances: of the mean a priori, `(n,)`.
        generator: of random numbers.
    """
    precision = torch.linalg.inv(covariance)
    whole = len(places) * precision + torch.diag(1.0 / variances)
    factor = torch.linalg.cholesky(whole)
    right = precision @ places.sum(0) + center / variances
    normal = torch.randn(len(center), generator=generator, dtype=torch.float64)
    mean = torch.cholesky_solve(right[:, None], factor)[:, 0]
    away = torch.linalg.solve_triangular(factor.mT, normal[:, None], upper=True)[:, 0]
    drawn: Tensor = mean + away
    return drawn
