"""A population of drivers: parameters and noise of each, and how they are distributed among them.

Logits of drivers' parameters are normal among drivers, with a mean and a covariance that are found
from all recordings at once. The population is then the prior of each driver: where their recording
says little, they are like the others, and as much as the recordings say (empirical Bayes). New
drivers drawn from it have parameters that belong together.

    driver's logits ~ normal(mean, covariance)
    errors given the logits ~ autoregressive noise

Mean and covariance are those of highest density given Laplace's approximation of each driver, by
expectation and maximisation (Dempster, Laird and Rubin 1977), and the approximation is made anew
with them. The prior of a driver without a population counts as `PSEUDO` further drivers.

Shapes: P drivers, n tuned parameters, d coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.plugin import ParameterSpace
from cfx_posteriors.density import ParameterPrior, Posterior, normal_draws
from cfx_posteriors.laplace import Normal, laplace

PSEUDO = 1.0
"""As many drivers as the prior of the population counts for."""

_ROUNDS, _STEPS = 3, 300
"""Rounds of Laplace's approximation, and steps of expectation and maximisation in each."""


@dataclass(frozen=True)
class Population:
    """How drivers' parameters are distributed: their logits are normal.

    Attributes:
        space: of the parameters.
        mean: of logits, `(n,)`.
        covariance: of logits among drivers, `(n, n)`.
    """

    space: ParameterSpace
    mean: Tensor
    covariance: Tensor

    @property
    def prior(self) -> ParameterPrior:
        """The prior of a driver of this population."""
        return ParameterPrior(self.mean, torch.linalg.inv(self.covariance))

    @property
    def center(self) -> Tensor:
        """Parameters of the driver in the middle, `(n,)`, SI units."""
        return self.space.from_unit(torch.sigmoid(self.mean))

    def draw(self, drivers: int, *, seed: int = 0) -> Tensor:
        """Returns parameters of new drivers, `(drivers, n)`, SI units, as correlated as theirs."""
        generator = torch.Generator().manual_seed(seed)
        logits = normal_draws(self.mean, self.covariance, drivers, generator)
        return self.space.from_unit(torch.sigmoid(logits))


def fit_population(posterior: Posterior, normal: Normal) -> tuple[Population, Posterior, Normal]:
    """Finds the population of drivers, and each driver's posterior within it.

    Args:
        posterior: of P drivers, with the prior that the model's bounds and defaults give.
        normal: Laplace's approximation of it.

    Returns:
        The population, the posterior with it as the prior, and Laplace's approximation of that.
    """
    first = posterior.prior
    n = len(posterior.space)
    half = torch.tensor([0.5], dtype=torch.float64)
    middle = first.quantiles(half, n)[0]
    spread = torch.linalg.inv(first.precision)
    population = Population(posterior.space, middle, spread)
    within = posterior
    for _ in range(_ROUNDS):
        precision, pull = _said(within.prior, normal, n)
        population = _expected(precision, pull, population, middle, spread)
        within = replace(posterior, prior=population.prior)
        normal = laplace(within, normal.mode[:, None, : posterior.simulated])
    return population, within, normal


def _said(prior: ParameterPrior, normal: Normal, n: int) -> tuple[Tensor, Tensor]:
    """Returns what recordings alone say: precisions `(P, n, n)`, and precision times place."""
    whole = torch.linalg.inv(normal.covariance[:, :n, :n])
    values, directions = torch.linalg.eigh(whole - prior.precision)
    precision = directions * values.clamp(min=0.0)[:, None] @ directions.mT
    # The slope of the density is 0 at the mode, so that of the recording is minus the prior's.
    mode = normal.mode[:, :n]
    slope = -prior.slope(mode[:, None])[:, 0]
    return precision, (precision @ mode[..., None])[..., 0] + slope


def _expected(
    precision: Tensor, pull: Tensor, population: Population, middle: Tensor, spread: Tensor
) -> Population:
    """Returns the population of highest density, given what recordings say."""
    mean, covariance = population.mean, population.covariance
    drivers = len(pull)
    for _ in range(_STEPS):
        before = torch.linalg.inv(covariance)
        own = torch.linalg.inv(precision + before)
        places = (own @ (pull + before @ mean)[..., None])[..., 0]
        mean = (places.sum(0) + PSEUDO * middle) / (drivers + PSEUDO)
        away = places - mean
        among = own.sum(0) + away.mT @ away
        covariance = (among + PSEUDO * spread) / (drivers + PSEUDO)
    return Population(population.space, mean, covariance)
