"""Samples where importance sampling does not settle: tempered sequential Monte Carlo.

Samples of the prior come to the posterior step by step: the likelihood counts with a power that
rises from 0 to 1 as fast as half of the samples stay effective. After each rise samples are drawn
anew by their weights and moved by Metropolis's steps: normal ones, as wide and as correlated as the
samples, and differences of two other samples, which lead from one mode to another. Neither slopes
nor a mode are needed, so densities that jump do no harm.

P. Del Moral, A. Doucet and A. Jasra (2006), *Sequential Monte Carlo samplers*, Journal of the Royal
Statistical Society B 68(3). C. J. F. ter Braak (2006), *A Markov chain Monte Carlo version of the
genetic algorithm differential evolution*, Statistics and Computing 16(3).

Shapes: P drivers, N samples of each, d coordinates.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cfx_posteriors import noise
from cfx_posteriors.density import Posterior

SAMPLES = 1000

_MOVES, _LAST_MOVES = 6, 12
"""Metropolis's steps after each rise, and after the last one."""

_STAY = 0.5
"""Share of the samples that stay effective as the power rises."""

_NEAR = 1e-3
"""Standard deviation of what is added to differences."""

_MOST_ROUNDS = 60
_HALVINGS = 25
_ACCEPTED = 0.25
"""Share of Metropolis's steps that should be accepted."""


class _Crowd(NamedTuple):
    """Samples on their way.

    Attributes:
        places: `(P, N, d)`.
        prior: log density before the recording is seen, `(P, N)`.
        likelihood: its logarithm, `(P, N)`.
        power: of the likelihood, `(P,)`.
        step: width of Metropolis's steps, in those of the samples, `(P,)`.
    """

    places: Tensor
    prior: Tensor
    likelihood: Tensor
    power: Tensor
    step: Tensor

    def of(self, drivers: Tensor) -> _Crowd:
        return _Crowd(*(values[drivers] for values in self))


def tempered(posterior: Posterior, seed: int) -> Tensor:
    """Returns equally likely samples of each driver's posterior, `(P, SAMPLES, d)`.

    All drivers have the same random numbers, so that a driver's samples depend on no other driver.
    """
    generator = torch.Generator().manual_seed(seed)
    crowd = whole = _first(posterior, generator, seed)
    left, part = torch.arange(len(whole.power)), posterior
    for number in range(_MOST_ROUNDS):
        crowd = _moved(part, _risen(crowd, generator), _MOVES, generator)
        ended = crowd.power >= 1.0
        if number == _MOST_ROUNDS - 1:
            ended[:] = True
        for values, new in zip(whole, crowd, strict=True):
            values[left[ended]] = new[ended]
        if bool(ended.all()):
            break
        on = (~ended).nonzero()[:, 0]
        left, part, crowd = left[on], part.take(on), crowd.of(on)
    generator.manual_seed(seed + 1)
    return _moved(posterior, whole, _LAST_MOVES, generator).places


def _first(posterior: Posterior, generator: torch.Generator, seed: int) -> _Crowd:
    drivers = posterior.segments.problems
    simulated = posterior.prior_draw(SAMPLES, seed=seed).expand(drivers, -1, -1)
    noises = noise.draw(SAMPLES, posterior.order, generator).expand(drivers, -1, -1)
    places = torch.cat([simulated, noises], dim=-1)
    step = torch.full((drivers,), 2.38 / math.sqrt(places.shape[-1]), dtype=torch.float64)
    return _Crowd(places, *_density(posterior, places), torch.zeros_like(step), step)


def _density(posterior: Posterior, places: Tensor) -> tuple[Tensor, Tensor]:
    """Returns log densities of prior and likelihood, `(P, N)` each."""
    of_noise = noise.prior_log_density(places[..., posterior.simulated :])
    prior = posterior.prior_log_density(places) + of_noise
    return prior, posterior(places) - prior


def _risen(crowd: _Crowd, generator: torch.Generator) -> _Crowd:
    """Returns samples that are drawn anew, with the next power."""
    low, high = crowd.power, torch.ones_like(crowd.power)
    whole = _effective(crowd, high) >= _STAY
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        stays = _effective(crowd, middle) >= _STAY
        low, high = torch.where(stays, middle, low), torch.where(stays, high, middle)
    power = torch.where(whole, 1.0, low)
    weights = ((power - crowd.power)[:, None] * crowd.likelihood).softmax(dim=1)
    start = torch.rand(1, generator=generator, dtype=torch.float64)
    wanted = ((torch.arange(SAMPLES) + start) / SAMPLES).expand(len(weights), -1).contiguous()
    place = torch.searchsorted(weights.cumsum(dim=1), wanted).clamp(max=SAMPLES - 1)
    return _Crowd(
        crowd.places.gather(1, place[..., None].expand_as(crowd.places)),
        crowd.prior.gather(1, place),
        crowd.likelihood.gather(1, place),
        power,
        crowd.step,
    )


def _effective(crowd: _Crowd, power: Tensor) -> Tensor:
    """Returns the share of samples that a power leaves effective (Kish), `(P,)`."""
    weights = ((power - crowd.power)[:, None] * crowd.likelihood).log_softmax(dim=1)
    return torch.exp(-torch.logsumexp(2.0 * weights, dim=1)) / SAMPLES


def _moved(posterior: Posterior, crowd: _Crowd, moves: int, generator: torch.Generator) -> _Crowd:
    """Returns samples after some of Metropolis's steps."""
    d = crowd.places.shape[-1]
    away = crowd.places - crowd.places.mean(1, keepdim=True)
    covariance = away.mT @ away / SAMPLES + 1e-6 * torch.eye(d, dtype=away.dtype)
    factor = torch.linalg.cholesky(covariance)
    everybody = torch.arange(SAMPLES)
    for number in range(moves):
        if number % 2 == 0:
            normal = torch.randn((SAMPLES, d), generator=generator, dtype=away.dtype)
            shift = crowd.step[:, None, None] * (normal @ factor.mT)
            crowd, accepted = _metropolis(posterior, crowd, everybody, shift, generator)
            crowd = crowd._replace(step=crowd.step * torch.exp(accepted - _ACCEPTED))
            continue
        scale = 1.0 if number % 4 == 3 else 2.38 / math.sqrt(2 * d)
        # Differences are of the other half, so that they do not depend on who moves.
        for moving, others in (
            (everybody[::2], everybody[1::2]),
            (everybody[1::2], everybody[::2]),
        ):
            place, other = (
                crowd.places[:, others[torch.randperm(len(others), generator=generator)]]
                for _ in range(2)
            )
            normal = torch.randn((len(moving), d), generator=generator, dtype=away.dtype)
            shift = scale * (place - other) + _NEAR * normal
            crowd, _ = _metropolis(posterior, crowd, moving, shift, generator)
    return crowd


def _metropolis(
    posterior: Posterior, crowd: _Crowd, moving: Tensor, shift: Tensor, generator: torch.Generator
) -> tuple[_Crowd, Tensor]:
    """Returns the crowd after one step of some samples, and how many accept it, `(P,)`.

    Args:
        posterior: of P drivers.
        crowd: all samples.
        moving: numbers of those M that move.
        shift: of theirs, `(P, M, d)`.
        generator: of random numbers.
    """
    places, prior, likelihood = (values[:, moving] for values in crowd[:3])
    tried = places + shift
    new_prior, new_likelihood = _density(posterior, tried)
    rise = new_prior - prior + crowd.power[:, None] * (new_likelihood - likelihood)
    chance = torch.rand(len(moving), generator=generator, dtype=rise.dtype).log()
    goes = chance < rise
    return crowd._replace(
        places=crowd.places.index_copy(1, moving, torch.where(goes[..., None], tried, places)),
        prior=crowd.prior.index_copy(1, moving, torch.where(goes, new_prior, prior)),
        likelihood=crowd.likelihood.index_copy(
            1, moving, torch.where(goes, new_likelihood, likelihood)
        ),
    ), goes.double().mean(1)
