"""A population of drivers: parameters and noise of each, and how they are distributed among them.

Logits of drivers' parameters are normal among drivers. Mean and covariance are drawn, not found:
some drivers say little of them, least of what none of their recordings determines.

    mean ~ the prior of a driver without a population
    standard deviations among drivers ~ half t, 2 degrees of freedom, the prior's as its scale;
        correlations are uniform
    driver's logits ~ normal(mean, covariance)
    errors given the logits ~ autoregressive noise

The population is the prior of each driver: where their recording says little, they are like the
others. Several chains run side by side, each with a population and all drivers. In each step

- drivers are drawn anew among samples of their posterior with a wide prior, weighted by the ratio
  of the population's density and that of the prior (iterated importance sampling),
- they take one of Metropolis's steps, along the difference of two such samples: where a model has
  many parameters few samples have all of the weight (of 250 of W99's two or three),
- mean and covariance are drawn given the drivers (Gibbs), the latter by the hierarchy of inverse
  Wishart distributions of Huang and Wand,
- one parameter of all drivers moves together with its mean, or away from it together with its
  deviation. What no recording determines hardly moves otherwise: drivers hold the population, and
  the population the drivers. Without it R-hat of 60 Krauss drivers, whose t_i no recording tells,
  is 1.22 instead of 1.02 in the median after 1,600 steps.

With mean and covariance of highest density in place of draws 90 % intervals of IDM's desired speed
held 74 to 76 %.

A. Huang and M. P. Wand (2013), *Simple marginally noninformative prior distributions for covariance
matrices*, Bayesian Analysis 8(2). C. Andrieu, A. Lee and M. Vihola (2018), *Uniform ergodicity of
the iterated conditional SMC and geometric ergodicity of particle Gibbs samplers*, Bernoulli 24(2).
C. J. F. ter Braak and J. A. Vrugt (2008), *Differential Evolution Markov Chain with snooker updater
and fewer chains*, Statistics and Computing 18(4). Y. Yu and X.-L. Meng (2011), *To center or not to
center: that is not the question*, Journal of Computational and Graphical Statistics 20(3).

Shapes: P drivers, C chains, N samples of each driver, n tuned parameters, R draws of the
population, e coordinates but for the noise's scale, whose distribution given the others is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from arviz_stats.base.array import array_stats
from torch import Tensor

from cfx.plugin import MIXED, ParameterSpace, Task
from cfx_posteriors.chains import Chains, chains_of
from cfx_posteriors.density import ParameterPrior, Posterior
from cfx_posteriors.laplace import Normal, laplace

CHAINS = 8

_WARM_UP = 200
"""Steps in which widths of moves are learned. As many more follow; where these are too few, as many
as there were so far take their place, and so on."""

_ENOUGH = 50.0
"""Effective draws of each mean and deviation of the population, with which chains end."""

_MOST_DRIVERS = 0.95
"""Share of the drivers whose chains are the same as far as R-hat tells, with which they end."""

_MOST_STEPS = 1600

_KEPT = 100
"""Draws of each chain that are kept."""

_FREEDOM = 2.0
"""Degrees of freedom of the half t distributions: correlations are uniform then."""

_WIDER = 2.0
"""By how much the prior of the samples has larger variances than that of a driver without a
population: a population cannot come to be wide where samples are few. With 1 the intervals of 60
IDM drivers (30 s, errors of the trajectory, four seeds) held 84 instead of 86 % (with inverse
Wishart covariances)."""

_AMONG = 50
"""Samples among which a driver is drawn."""

_ACCEPTED = 0.3
"""Share of the other moves that should be accepted."""

_JUMPS = 0.1
"""Share of the steps along whole differences, which lead from one mode to another."""

_NEAR = 1e-3
"""Deviation of what is added to a difference, in deviations of the samples."""

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


class _State(NamedTuple):
    """Where chains stand.

    Attributes:
        places: of the drivers, `(P, C, e)`.
        likelihood: log likelihood there, `(P, C)`.
        mean: of the logits, `(C, n)`.
        covariance: of the logits among drivers, `(C, n, n)`.
        scale: the diagonal of that of the inverse Wishart distribution of the covariance, `(C, n)`.
    """

    places: Tensor
    likelihood: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor


def fit_population(
    posterior: Posterior,
    normal: Normal,
    draw: Callable[[Posterior, Normal], Tensor],
    shares: Tensor,
    *,
    seed: int,
    memory: int,
) -> tuple[Population, Tensor, Chains]:
    """Finds the population of drivers, and each driver's posterior within it.

    Args:
        posterior: of P drivers, with the prior that the model's bounds and defaults give.
        normal: Laplace's approximation of it.
        draw: equally likely samples of a posterior, given Laplace's approximation of it,
            `(P, N, d)`.
        shares: of the quantiles, within (0, 1).
        seed: the same seed gives the same population.
        memory: bound in bytes for the drivers that are simulated at once.

    Returns:
        The population, the drivers' likeliest coordinates within it, `(P, d)`, and their chains.
    """
    prior = posterior.prior
    if prior.center is not None:  # uniform between the bounds, all of it is wide
        prior = replace(prior, precision=prior.precision / _WIDER)
    wide = replace(posterior, prior=prior)
    mode = normal.mode[:, None, : posterior.simulated]
    walk = _Walk(posterior, wide, draw(wide, laplace(wide, mode))[..., :-1], seed, memory)
    with Task(f"Sampling {CHAINS} populations of {len(mode)} drivers", _MOST_STEPS) as task:
        walk.go_on(_WARM_UP, task, learning=True)
        kept = walk.go_on(_WARM_UP, task)
        while walk.steps < _MOST_STEPS and not _enough(kept):
            kept = walk.go_on(walk.steps, task)
    population = Population(
        posterior.space,
        torch.cat([state.mean for state in kept]),
        torch.cat([state.covariance for state in kept]),
    )
    places = torch.stack([state.places for state in kept], dim=2)
    scales = posterior.draw_scales(places.flatten(1, 2), walk.generator)
    places = torch.cat([places, scales.view(*places.shape[:3], 1)], dim=-1)
    within = replace(posterior, prior=population.middle)
    likeliest = laplace(within, mode).mode
    return population, likeliest, chains_of(places, len(posterior.space), shares)


def _enough(kept: Sequence[_State]) -> bool:
    """Returns whether draws of the population are enough, and the chains of most drivers mixed."""
    mean = torch.stack([state.mean for state in kept])
    deviation = torch.stack([state.covariance for state in kept]).diagonal(dim1=-2, dim2=-1)
    draws = torch.cat([mean, deviation.log()], dim=-1).numpy()
    if (array_stats.ess(draws, chain_axis=1, draw_axis=0) < _ENOUGH).any():
        return False
    places = torch.stack([state.places for state in kept]).numpy()
    r_hat = array_stats.rhat(places, chain_axis=2, draw_axis=0).max(-1)
    return bool((r_hat <= MIXED).mean() >= _MOST_DRIVERS)


class _Walk:
    """Chains of populations with their drivers, and how wide their moves are.

    Attributes:
        state: where they stand.
        steps: so far.
        generator: of random numbers.
    """

    def __init__(
        self, posterior: Posterior, wide: Posterior, samples: Tensor, seed: int, memory: int
    ) -> None:
        """Starts each chain at a sample of each driver.

        Args:
            posterior: of P drivers.
            wide: the same with another prior.
            samples: equally likely ones of the latter, `(P, N, e)`.
            seed, memory: as of `fit_population`.
        """
        drivers, count, e = samples.shape
        n = len(posterior.space)
        self.steps = 0
        self.generator = torch.Generator().manual_seed(seed)
        self.samples, self.prior = samples, wide.prior
        size = max(1, memory // (CHAINS * posterior.bytes_per_candidate))
        self.parts = [posterior.take(part) for part in torch.split(torch.arange(drivers), size)]
        columns = torch.split(samples, CHAINS, dim=1)
        self.of_samples = torch.cat([self._likelihood(column) for column in columns], dim=1)
        self.of_prior = self.prior.log_density(samples[..., :n])
        self.near = _NEAR * samples.std(dim=1, keepdim=True)
        self.center = posterior.prior.quantiles(torch.tensor([0.5], dtype=torch.float64), n)[0]
        self.variances = torch.linalg.inv(posterior.prior.precision).diagonal()
        self.width = torch.full((drivers, 1), 2.38 / math.sqrt(2 * e), dtype=torch.float64)
        self.shift_width = self.variances.sqrt() / math.sqrt(drivers)
        self.stretch_width = torch.full_like(self.variances, 1.0 / math.sqrt(drivers))
        which = self._numbers(count, drivers, CHAINS)
        places = self._samples(which)
        likelihood = self.of_samples.gather(1, which)
        mean, scale = places[..., :n].mean(0), self.variances.expand(CHAINS, n)
        covariance = self._covariance(places, mean, scale)
        self.state = _State(places, likelihood, mean, covariance, scale)

    def go_on(self, steps: int, task: Task, *, learning: bool = False) -> list[_State]:
        """Takes so many steps; returns `_KEPT` of the states.

        Args:
            steps: a multiple of `_KEPT`.
            task: learns of each step.
            learning: whether the widths of moves change.
        """
        kept = []
        n, every = len(self.center), steps // _KEPT
        for number in range(steps):
            rate = 2.0 / math.sqrt(1.0 + number) if learning else 0.0
            self._choose()
            self._move(rate)
            self._draw_population()
            parameter, stretches = divmod(number % (2 * n), 2)
            (self._stretch if stretches else self._shift)(parameter, rate)
            if number % every == 0:
                kept.append(self.state)
            task.advance()
        self.steps += steps
        return kept

    def _choose(self) -> None:
        """Draws each driver among where they are and some of their samples."""
        state, drivers = self.state, len(self.samples)
        which = self._numbers(self.samples.shape[1], drivers, CHAINS * _AMONG)
        shape = (drivers, CHAINS, _AMONG)
        prior_here = self.prior.log_density(state.places[..., : len(self.center)])
        places = _before(state.places, self._samples(which).view(*shape, -1))
        likelihood = _before(state.likelihood, self.of_samples.gather(1, which).view(shape))
        of_prior = _before(prior_here, self.of_prior.gather(1, which).view(shape))
        density = self._density(places.transpose(1, 2)).transpose(1, 2)
        shares = (density - of_prior).softmax(dim=-1).cumsum(dim=-1)
        chosen = torch.searchsorted(shares, self._uniform(drivers, CHAINS, 1)).clamp(max=_AMONG)
        number = chosen[..., None].expand(-1, -1, -1, places.shape[-1])
        self.state = state._replace(
            places=places.gather(2, number)[:, :, 0],
            likelihood=likelihood.gather(2, chosen)[..., 0],
        )

    def _move(self, rate: float) -> None:
        """Moves drivers along the difference of two samples, or leaves them, one by one.

        Args:
            rate: at which widths are learned.
        """
        state, (drivers, count, _) = self.state, self.samples.shape
        jumps = float(self._uniform(1)) < _JUMPS
        one, other = (self._samples(self._numbers(count, drivers, CHAINS)) for _ in range(2))
        width = torch.ones_like(self.width) if jumps else self.width
        near = self.near * self._normal(*one.shape)
        tried = state.places + width[..., None] * (one - other) + near
        likelihood = self._likelihood(tried)
        rise = likelihood - state.likelihood + self._density(tried) - self._density(state.places)
        goes = self._uniform(*rise.shape).log() < rise
        self.state = state._replace(
            places=torch.where(goes[..., None], tried, state.places),
            likelihood=torch.where(goes, likelihood, state.likelihood),
        )
        if not jumps:
            accepted = rise.clamp(max=0.0).exp().mean(1, keepdim=True)
            self.width = self.width * torch.exp(rate * (accepted - _ACCEPTED))

    def _draw_population(self) -> None:
        """Draws mean and covariance, given drivers."""
        places, mean = self.state.places, self.state.mean
        covariance = self._covariance(places, mean, self.state.scale)
        scale = self._scale(covariance)
        mean = self._mean(places, covariance)
        self.state = self.state._replace(mean=mean, covariance=covariance, scale=scale)

    def _shift(self, parameter: int, rate: float) -> None:
        """Moves a parameter of all drivers of a chain as far as its mean.

        Args:
            parameter: its number.
            rate: at which widths are learned.
        """
        state = self.state
        shift = self.shift_width[parameter] * self._normal(CHAINS)
        places, mean = state.places.clone(), state.mean.clone()
        places[..., parameter] += shift
        mean[:, parameter] += shift
        away, before = (of[:, parameter] - self.center[parameter] for of in (mean, state.mean))
        rise = 0.5 * (before.square() - away.square()) / self.variances[parameter]
        goes, accepted = self._move_together(places, rise)
        self.state = self.state._replace(mean=torch.where(goes[:, None], mean, state.mean))
        self.shift_width[parameter] *= math.exp(rate * (accepted - _ACCEPTED))

    def _stretch(self, parameter: int, rate: float) -> None:
        """Moves a parameter of all drivers of a chain away from its mean, as does its deviation.

        How many deviations each driver is away stays. The density of an inverse Wishart
        distribution with f degrees of freedom and a diagonal scale, by the logarithm of one
        deviation s, is s^-f exp(-scale * inverse covariance / 2): both of the parameter.

        Args:
            parameter: its number.
            rate: at which widths are learned.
        """
        state = self.state
        stretch = self.stretch_width[parameter] * self._normal(CHAINS)
        factor = stretch.exp()
        mean = state.mean[:, parameter]
        places, covariance = state.places.clone(), state.covariance.clone()
        places[..., parameter] = mean + factor * (places[..., parameter] - mean)
        covariance[:, parameter] *= factor[:, None]
        covariance[:, :, parameter] *= factor[:, None]
        precision = torch.linalg.inv(state.covariance)[:, parameter, parameter]
        fall = self._freedom * stretch
        fall = fall + 0.5 * state.scale[:, parameter] * precision * (factor.pow(-2) - 1.0)
        goes, accepted = self._move_together(places, -fall)
        self.state = self.state._replace(
            covariance=torch.where(goes[:, None, None], covariance, state.covariance)
        )
        self.stretch_width[parameter] *= math.exp(rate * (accepted - _ACCEPTED))

    def _move_together(self, places: Tensor, population: Tensor) -> tuple[Tensor, float]:
        """Moves all drivers of a chain, or none.

        Args:
            places: where to, `(P, C, e)`.
            population: by how much its log density rises, `(C,)`.

        Returns:
            Which chains move, bool `(C,)`, and how likely they were to, in the mean.
        """
        state = self.state
        likelihood = self._likelihood(places)
        rise = (likelihood - state.likelihood).sum(0) + population
        goes = self._uniform(CHAINS).log() < rise
        self.state = state._replace(
            places=torch.where(goes[:, None], places, state.places),
            likelihood=torch.where(goes, likelihood, state.likelihood),
        )
        return goes, float(rise.clamp(max=0.0).exp().mean())

    def _likelihood(self, places: Tensor) -> Tensor:
        """Returns the log likelihood of coordinates `(P, C, e)`, `(P, C)`."""
        sizes = [part.segments.problems for part in self.parts]
        of_parts = zip(self.parts, torch.split(places, sizes), strict=True)
        return torch.cat([part.likelihood(place) for part, place in of_parts])

    def _density(self, places: Tensor) -> Tensor:
        """Returns the log density of coordinates `(P, ..., C, e)` in the populations.

        `(P, ..., C)`, up to a constant of each chain.
        """
        away = places[..., : len(self.center)] - self.state.mean
        precision = torch.linalg.inv(self.state.covariance)
        density: Tensor = -0.5 * ((away[..., None, :] @ precision)[..., 0, :] * away).sum(-1)
        return density

    @property
    def _freedom(self) -> float:
        """Degrees of freedom of the inverse Wishart distribution."""
        return _FREEDOM + len(self.center) - 1

    def _covariance(self, places: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
        """Returns a covariance of each chain.

        Args:
            places: of the drivers, `(P, C, e)`.
            mean, scale: of the chains, `(C, n)` each.
        """
        away = (places[..., : len(self.center)] - mean).transpose(0, 1)
        scatter = away.mT @ away + torch.diag_embed(scale)
        freedom = self._freedom + len(places)
        precision = _wishart(freedom, torch.linalg.inv(scatter), self.generator)
        covariance: Tensor = torch.linalg.inv(precision)
        return covariance

    def _scale(self, covariance: Tensor) -> Tensor:
        """Returns the scale of each chain `(C, n)`, given covariances."""
        precision = torch.linalg.inv(covariance).diagonal(dim1=-2, dim2=-1)
        rate = _FREEDOM * precision + 1.0 / self.variances
        shape = torch.full_like(rate, 0.5 * (_FREEDOM + rate.shape[1]))
        gamma = torch._standard_gamma(shape, generator=self.generator)  # noqa: SLF001 - the only one with a generator
        scale: Tensor = 2.0 * _FREEDOM * gamma / rate
        return scale

    def _mean(self, places: Tensor, covariance: Tensor) -> Tensor:
        """Returns a mean of each chain, given drivers `(P, C, e)` and covariances."""
        n = len(self.center)
        precision = torch.linalg.inv(covariance)
        factor = torch.linalg.cholesky(len(places) * precision + torch.diag(1.0 / self.variances))
        total = places[..., :n].sum(0)[..., None]
        right = precision @ total + (self.center / self.variances)[:, None]
        away = torch.linalg.solve_triangular(factor.mT, self._normal(CHAINS, n, 1), upper=True)
        drawn: Tensor = torch.cholesky_solve(right, factor) + away
        return drawn[..., 0]

    def _samples(self, numbers: Tensor) -> Tensor:
        """Returns samples of each driver by their numbers `(P, q)`, `(P, q, e)`."""
        return self.samples.gather(1, numbers[..., None].expand(-1, -1, self.samples.shape[-1]))

    def _numbers(self, below: int, *shape: int) -> Tensor:
        return torch.randint(below, shape, generator=self.generator)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, dtype=torch.float64)


def _before(first: Tensor, others: Tensor) -> Tensor:
    """Returns one value `(P, C, ...)` and further ones `(P, C, q, ...)` in one tensor."""
    return torch.cat([first[:, :, None], others], dim=2)


def _wishart(freedom: float, scale: Tensor, generator: torch.Generator) -> Tensor:
    """Returns draws of Wishart distributions (Bartlett's decomposition), `(C, n, n)`.

    Args:
        freedom: degrees of freedom.
        scale: of each, `(C, n, n)`.
        generator: of random numbers.
    """
    chains, n, _ = scale.shape
    shape = 0.5 * (freedom - torch.arange(n, dtype=torch.float64)).expand(chains, n)
    chi = 2.0 * torch._standard_gamma(shape.contiguous(), generator=generator)  # noqa: SLF001 - the only one with a generator
    lower = torch.randn((chains, n, n), generator=generator, dtype=torch.float64).tril(-1)
    factor = torch.linalg.cholesky(scale) @ (lower + torch.diag_embed(chi.sqrt()))
    drawn: Tensor = factor @ factor.mT
    return drawn
