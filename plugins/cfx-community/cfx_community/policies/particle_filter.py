"""The particle filter of a driver's parameters (`policy=particle_filter`).

N. J. Gordon, D. J. Salmond and A. F. M. Smith (1993), *Novel approach to nonlinear/non-Gaussian
Bayesian state estimation*, IEE Proc. F 140(2). G. Kitagawa (1996), *Monte Carlo filter and smoother
for non-Gaussian nonlinear state space models*, J. Comput. Graph. Stat. 5(1): systematic resampling.

Shapes: `*batch` any leading dimensions, M particles, n parameters.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor

from cfx.plugin import History, Settings
from cfx_community.policies.estimator import (
    DrivenModel,
    EstimatorNetwork,
    EstimatorPolicy,
    bounded,
)
from cfx_community.policies.ukf import FilterSettings

_TABLES = 64
"""Windows after which the same draws come again: 32 s with windows of half a second."""

_LOWEST = 0.5
"""Effective share of the particles below which they are drawn anew."""


class ParticleFilterSettings(FilterSettings):
    """Settings of `particle_filter`."""

    particles: int = Field(1000, ge=2, le=100_000, description="parameter sets of each driver")


class ParticleFilterPolicy(EstimatorPolicy):
    """A thousand parameter sets per driver, weighted by their likelihood.

    It assumes what `policy=ukf` assumes, with any shape of the belief: particles are drawn around
    the pooled parameters in the squashed space and change at random with `drift`. In each window a
    particle's weight is multiplied by the likelihood of the measured mean acceleration given that
    which it simulates. Where few of them carry all the weight they are drawn anew (systematic
    resampling). Once the policy drives, the mean is kept.

    Draws follow from the job's seed and the number of the window, and are the same for all drivers:
    what one driver gets does not depend on who else is estimated.
    """

    schema: ClassVar[type[Settings]] = ParticleFilterSettings
    settings: ParticleFilterSettings

    def estimator(
        self, driven: DrivenModel, prior: Tensor, generator: torch.Generator
    ) -> EstimatorNetwork:
        seed = torch.randint(2**31, (1,), generator=generator)
        return ParticleFilterNetwork(driven, prior, self.settings, seed.expand(len(prior)))


class ParticleFilterNetwork(EstimatorNetwork):
    """Beliefs are the number of the window, M logarithms of weights, and M n parameters."""

    def __init__(
        self, driven: DrivenModel, prior: Tensor, settings: ParticleFilterSettings, seed: Tensor
    ) -> None:
        super().__init__(driven, prior)
        self._settings = settings
        self.seed: Tensor
        self.register_buffer("seed", seed.clone())
        self._drawn: tuple[int, Tensor, Tensor] | None = None

    def initial_belief(self, prior: Tensor) -> Tensor:
        count, n = self._settings.particles, prior.shape[-1]
        noise, _ = self._draws(prior)
        particles = bounded(prior[..., None, :] + self._settings.spread * noise[0])
        weights = prior.new_zeros((*prior.shape[:-1], 1 + count))
        return torch.cat([weights, particles.reshape(*prior.shape[:-1], count * n)], -1)

    def updated(self, history: History, belief: Tensor) -> Tensor:
        number, weights, particles = self._parts(belief)
        table = number.remainder(_TABLES - 1).long() + 1
        noise, uniform = self._draws(particles)
        seconds = self.driven.windows.stride * self.driven.dt
        scale = self._settings.drift * math.sqrt(seconds)
        particles = bounded(particles + scale * noise[table])
        error = self.simulated_acceleration(history, particles)
        error = error - self.measured_acceleration(history)[..., None]
        particles, weights = reweighted(
            particles, weights, -0.5 * (error / self._settings.noise).square(), uniform[table]
        )
        return torch.cat([number[..., None] + 1.0, weights, particles.flatten(-2)], -1)

    def estimate(self, belief: Tensor) -> Tensor:
        _, weights, particles = self._parts(belief)
        return (weights.softmax(-1)[..., None] * particles).sum(-2)

    def _parts(self, belief: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        count = self._settings.particles
        weights, particles = belief[..., 1 : 1 + count], belief[..., 1 + count :]
        return belief[..., 0], weights, particles.reshape(*belief.shape[:-1], count, -1)

    def _draws(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Returns normal draws `(tables, M, n)` and uniform ones `(tables,)`."""
        seed = int(self.seed[0])
        if self._drawn is None or self._drawn[0] != seed:
            generator = torch.Generator().manual_seed(seed)
            shape = (_TABLES, self._settings.particles, like.shape[-1])
            noise = torch.randn(shape, generator=generator, dtype=torch.float64)
            uniform = torch.rand(_TABLES, generator=generator, dtype=torch.float64)
            self._drawn = (seed, noise.to(like), uniform.to(like))
        return self._drawn[1], self._drawn[2]


def reweighted(
    particles: Tensor, weights: Tensor, likelihood: Tensor, uniform: Tensor
) -> tuple[Tensor, Tensor]:
    """Multiplies weights by likelihoods, and draws particles anew where few carry the weight.

    Args:
        particles: `(*batch, M, n)`.
        weights: their logarithms, `(*batch, M)`, not normalised.
        likelihood: its logarithm up to a constant, `(*batch, M)`.
        uniform: one draw from [0, 1) for each resampling, `(*batch,)`.

    Returns:
        Particles and logarithms of normalised weights.
    """
    after = weights + likelihood.nan_to_num(nan=-torch.inf)
    after = after - after.logsumexp(-1, keepdim=True)
    # Where no particle explains the window at all, it says nothing.
    after = torch.where(after.isfinite().any(-1, keepdim=True), after, weights.log_softmax(-1))
    count = after.shape[-1]
    effective = 1.0 / after.exp().square().sum(-1)
    is_poor = effective < _LOWEST * count
    if not bool(is_poor.any()):
        return particles, after
    places = torch.arange(count, dtype=after.dtype, device=after.device)
    places = (places + uniform[..., None]) / count
    chosen = torch.searchsorted(after.exp().cumsum(-1), places).clamp(max=count - 1)
    drawn = particles.gather(-2, chosen[..., None].expand_as(particles))
    equal = torch.full_like(after, -math.log(count))
    particles = torch.where(is_poor[..., None, None], drawn, particles)
    return particles, torch.where(is_poor[..., None], equal, after)
