"""Samples by a network that learns from simulations: neural posterior estimation (sbi).

Nothing is asked of a model but forward simulations, and those come in a few batches: of all drivers
and many parameters at once. In each round parameters and noise are drawn from a region of each
driver's own, and simulated. A normalizing flow learns which were behind which recording, one flow
for all drivers: in coordinates in which its region is standard normal, each driver's posterior is
about alike, and a few numbers that belong to a driver say how it differs. What it reads of a
recording are estimates by a linear model of the round's simulations, at three correlations of the
noise, and scale and correlation of what these leave. Its samples for the real recordings, and those
of a wider Student's t distribution, are weighted by the posterior density over that of the mixture
of all rounds, and smoothed (`importance`): the weights say how good the flow is, mend what it
misses, and give the next region. Where they do not settle, the last round's flow has the word.

G. Papamakarios and I. Murray (2016), *Fast epsilon-free inference of simulation models with
Bayesian conditional density estimation*, NeurIPS 29: rounds, and the correction for regions. M. Dax
et al. (2023), *Neural importance sampling for rapid and reliable gravitational-wave inference*,
Physical Review Letters 130(17). M. Deistler et al. (2025), *Simulation-based inference: a practical
guide*, arXiv:2508.12939.

Shapes: P drivers, n tuned parameters, d coordinates, m the order of the noise, K steps, q
simulations of each driver, N samples.
"""

from __future__ import annotations

import copy
import math
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from sbi.diagnostics import run_sbc
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from cfx.plugin import INTERVAL_LEVEL, MAX_PARETO_K
from cfx_posteriors import noise
from cfx_posteriors.density import Posterior
from cfx_posteriors.importance import (
    DRAWS,
    SAMPLES,
    Components,
    effective_size,
    pareto_smoothed,
    settled,
    systematic,
    tempering_power,
    weighted_quantiles,
)
from cfx_posteriors.random_numbers import DrawsFrom

FIRST = 500
"""Simulations of each driver all over the prior, which give the first region."""

ROUNDS, EPOCHS = 8, 7
"""Rounds at most, and passes over its simulations in each. A flow goes on where it was."""

SIMULATIONS, _LEAST, _MOST = 8000, 100, 300
"""Simulations that the flow of a round learns from: of all drivers, of each at least and at most.
A simulation is cheap beside the time in which the flow learns, but for simulators elsewhere."""

_COPIES = 4
"""Recordings of each simulation, each with noise of its own."""

_OF_FLOW, _OF_TAILS = 600, 2.0
"""Samples of the flow in each round, and of the wider distribution, in multiples of `SAMPLES`."""

_WIDER = 1.5
"""By how much a region's covariance is larger than that of the samples it is made of."""

_CORRELATIONS = (0.6, 0.0, 0.9)
"""Of the noise in a linear model. Noise is estimated from what is left by the first one."""

_CHECKED = 300
"""Simulations of all drivers that say how often the flow's intervals hold what they should."""

_BATCHES, _LEAST_BATCH, _MOST_BATCH, _RATE = 40, 50, 500, 3e-3
"""Batches in a pass, unless they would be too small or large: few drivers' flows take as many
steps."""

_HIDDEN, _READ, _OWN, _TRANSFORMS = 50, 32, 16, 4
"""Width of the layers, what they read of a recording and know of a driver, and the flow's steps."""

_FAR = 8.0
"""Deviations to which what is read of a recording counts."""


class Learned(NamedTuple):
    """What samples of P drivers' posteriors say.

    Attributes:
        quantiles: of each parameter's logit, `(P, shares, n)`.
        draws: equally weighted draws of all coordinates, `(P, DRAWS, d)`.
        effective: effective sample size of the weighted samples, `(P,)`.
        pareto_k: of the weights, `(P,)`; above 0.7 quantiles and draws are the flow's alone.
        coverage: how often 90 % intervals of the flow alone hold the truth of simulated
            recordings, of all drivers together, `(P,)`.
        likeliest: the sample of highest density, `(P, d)`.
    """

    quantiles: Tensor
    draws: Tensor
    effective: Tensor
    pareto_k: Tensor
    coverage: Tensor
    likeliest: Tensor

    @property
    def chains(self) -> int:
        """Draws are independent."""
        return 1

    @property
    def diagnostics(self) -> dict[str, Tensor]:
        """What says how far to trust them, `(P,)` each."""
        return {"pareto_k": self.pareto_k, "expected_coverage": self.coverage}


class _Region(NamedTuple):
    """Normal distributions that a round draws from.

    Attributes:
        middle: `(P, 1, d)`.
        factor: of the covariance, lower triangular, `(P, d, d)`.
    """

    middle: Tensor
    factor: Tensor

    @classmethod
    def of(cls, places: Tensor, log_weights: Tensor) -> _Region:
        """Returns a region somewhat wider than weighted samples `(P, N, d)`.

        A few samples have nearly all weight as long as regions are far too wide: their weights are
        raised to a power below 1.
        """
        weights = (tempering_power(log_weights)[:, None] * log_weights).softmax(dim=1)
        middle = (weights[..., None] * places).sum(1, keepdim=True)
        away = places - middle
        covariance = _WIDER * ((weights[..., None] * away).mT @ away)
        least = 1e-6 * torch.eye(places.shape[-1], dtype=places.dtype)
        return cls(middle, torch.linalg.cholesky(covariance + least))

    @property
    def tails(self) -> Components:
        """A Student's t distribution as wide."""
        share = torch.full_like(self.middle[..., 0], _OF_TAILS)
        return Components(self.middle, self.factor[:, None], share)

    def outer(self, standard: Tensor) -> Tensor:
        """Returns coordinates of places `(P, q, d)` that are standard normal within the region."""
        return self.middle + standard @ self.factor.mT

    def inner(self, places: Tensor) -> Tensor:
        """Returns the inverse of `outer`."""
        away = (places - self.middle).mT
        standard: Tensor = torch.linalg.solve_triangular(self.factor, away, upper=False).mT
        return standard


@dataclass(frozen=True)
class _Reader:
    """What a flow reads of a recording: see the module.

    Attributes:
        posterior: of P drivers.
        mean: errors in the middle of the region, `(K, P)`.
        slopes: by standard coordinates of the parameters, `(K, P, n)`.
        scale: of the noise in the middle, `(P,)`.
    """

    posterior: Posterior
    mean: Tensor
    slopes: Tensor
    scale: Tensor

    @classmethod
    def of(cls, posterior: Posterior, region: _Region, standard: Tensor, errors: Tensor) -> _Reader:
        """Fits the linear model.

        Args:
            posterior: of P drivers.
            region: that they were drawn from.
            standard: coordinates of parameters, `(P, q, n)`.
            errors: of these, `(K, P, q)`.
        """
        inputs = torch.cat([standard, torch.ones_like(standard[..., :1])], dim=-1)
        solved = torch.linalg.lstsq(inputs, errors.permute(1, 2, 0)).solution.permute(2, 0, 1)
        scale = region.middle[:, 0, -1].exp()
        return cls(posterior, solved[..., -1], solved[..., :-1], scale)

    def __call__(self, errors: Tensor) -> Tensor:
        """Returns what is read of errors `(K, P, q)`, `(P, q, 3 n + 2 m + 1)`."""
        scored, order = self.posterior.scored, self.posterior.order
        away = (errors - self.mean[..., None]) * self.posterior.counted
        identity = torch.eye(self.slopes.shape[-1], dtype=away.dtype)
        estimates = []  # of parameters, by weighted least squares for each correlation
        for correlation in away.new_tensor(_CORRELATIONS):
            slopes = noise.filtered(self.slopes, correlation[None]) * scored
            white = noise.filtered(away, correlation[None]) * scored
            slopes = slopes / self.scale[:, None]
            white = white / self.scale[:, None]
            precision = torch.einsum("kpi,kpj->pij", slopes, slopes) + identity
            projected = torch.einsum("kpi,kpq->piq", slopes, white)
            estimates.append(torch.linalg.solve(precision, projected))
        left = away - torch.einsum("kpi,piq->kpq", self.slopes, estimates[0])
        products = noise.lagged_products(left, scored, order)
        lags = products[..., 0, 1:] / products[..., :1, 0].clamp(min=1e-12)
        about = noise.first_noise(products, self.posterior.count)
        return torch.cat([*(estimate.mT for estimate in estimates), about, lags], dim=-1)


class _Embedding(nn.Module):
    """What a flow knows of a recording: of what is read, and of the driver."""

    def __init__(self, drivers: int, read: int) -> None:
        super().__init__()
        self.own = nn.Embedding(drivers, _OWN)
        layers = [nn.Linear(read + _OWN, _HIDDEN), nn.GELU(), nn.Linear(_HIDDEN, _HIDDEN)]
        self.layers = nn.Sequential(*layers, nn.GELU(), nn.Linear(_HIDDEN, _READ))

    def forward(self, x: Tensor) -> Tensor:
        """Returns it, `(rows, _READ)`; x has the number of the driver, then what is read."""
        embedded = self.own(x[:, 0].long())
        summary: Tensor = self.layers(torch.cat([x[:, 1:], embedded], dim=1))
        return summary


class _Silent:
    """Keeps nothing of how a flow learns; sbi's own would write TensorBoard's files."""

    log_dir = None

    def log_metric(self, *_: object, **__: object) -> None:
        """Keeps nothing."""

    log_metrics = log_params = add_figure = flush = log_metric


@dataclass(frozen=True)
class _Round:
    """A flow that has learned.

    Attributes:
        region: that its simulations were drawn from.
        flow: sbi's, of standard coordinates given what is read.
        posterior: sbi's, of the flow.
        observed: what is read of the real recordings, `(P, 1 + read)`.
        aside: standard coordinates and what is read of simulations that it has not learned from.
    """

    region: _Region
    flow: Any
    posterior: Any
    observed: Tensor
    aside: tuple[Tensor, Tensor]

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> Tensor:
        """Returns samples for the real recordings, `(P, N, d)`: the flow's, then wider ones."""
        standard = self.flow.sample((_OF_FLOW,), self.observed).transpose(0, 1).double()
        return torch.cat([self.region.outer(standard), self.region.tails.draw([generator])], dim=1)

    @torch.no_grad()
    def log_density(self, places: Tensor) -> Tensor:
        """Returns the log of both densities' sum at places `(P, N, d)`, by share, `(P, N)`."""
        standard = self.region.inner(places)
        density = self.flow.log_prob(standard.transpose(0, 1).float(), self.observed).T.double()
        size = self.region.factor.diagonal(dim1=1, dim2=2).log().sum(-1)
        of_flow = density - size[:, None] + math.log(_OF_FLOW / SAMPLES)
        return torch.logaddexp(of_flow, self.region.tails.log_density(places))

    def coverage(self) -> float:
        """Returns how often the flow's 90 % intervals hold the truth of simulations."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # sbi's that they are few
            ranks, _ = run_sbc(
                *self.aside, self.posterior, num_posterior_samples=200, show_progress_bar=False
            )
        away = (ranks / 200.0 - 0.5).abs()
        return float((away < 0.5 * INTERVAL_LEVEL).double().mean())


def learn(posterior: Posterior, shares: Tensor, *, seed: int, memory: int) -> Learned:
    """Returns samples of each driver's posterior.

    sbi draws from PyTorch's global generator; here it draws from one of its own.

    Args:
        posterior: of P drivers.
        shares: of the quantiles, within (0, 1).
        seed: the same seed gives the same samples.
        memory: bound in bytes for what is simulated at once.
    """
    with DrawsFrom(torch.Generator().manual_seed(seed)):
        return _learned(posterior, shares, seed, memory)


def _learned(posterior: Posterior, shares: Tensor, seed: int, memory: int) -> Learned:
    n = len(posterior.space)
    generator = torch.Generator().manual_seed(seed)
    region = _first_region(posterior, seed, memory)
    rounds: list[_Round] = []
    places = heights = mixture = torch.empty((posterior.segments.problems, 0), dtype=torch.float64)
    for _ in range(ROUNDS):
        rounds.append(_learn_round(posterior, region, rounds, generator, memory))
        drawn = rounds[-1].draw(generator)
        height = _density(posterior, drawn, memory)
        of_drawn = torch.stack([trained.log_density(drawn) for trained in rounds]).logsumexp(0)
        if len(rounds) == 1:
            places, heights, mixture = drawn, height, of_drawn
        else:
            before = torch.logaddexp(mixture, rounds[-1].log_density(places))
            places = torch.cat([places, drawn], dim=1)
            heights = torch.cat([heights, height], dim=1)
            mixture = torch.cat([before, of_drawn], dim=1)
        log_weights = torch.log_softmax(heights - mixture, dim=1)
        smooth, k = pareto_smoothed(log_weights)
        if bool(settled(smooth, k).all()):
            break
        region = _Region.of(places, log_weights)

    # The flow's own samples are of a prior that is its region.
    from_flow = drawn[:, :_OF_FLOW]
    prior = posterior.prior.log_density(from_flow[..., :n])
    prior = prior + noise.prior_log_density(from_flow[..., n:])
    inner = rounds[-1].region.inner(from_flow)
    of_flow = (prior + 0.5 * inner.square().sum(-1)).softmax(dim=1)
    trusted = (k <= MAX_PARETO_K)[:, None, None]
    weighted = weighted_quantiles(places[..., :n], smooth.exp(), shares)
    alone = weighted_quantiles(from_flow[..., :n], of_flow, shares)
    draws = systematic(places, smooth.exp(), DRAWS, [generator])
    draws_alone = systematic(from_flow, of_flow, DRAWS, [generator])
    best = heights.argmax(dim=1)
    return Learned(
        torch.where(trusted, weighted, alone),
        torch.where(trusted, draws, draws_alone),
        effective_size(smooth),
        k,
        torch.full_like(k, rounds[-1].coverage()),
        places[torch.arange(len(best)), best],
    )


def _first_region(posterior: Posterior, seed: int, memory: int) -> _Region:
    """Returns what places all over the prior, with noise that fits each roughly, say."""
    drivers, n = posterior.segments.problems, len(posterior.space)
    logits = posterior.prior.draw(FIRST, n, seed=seed).expand(drivers, -1, -1)
    places, densities = [], []
    for part in torch.split(logits, _at_once(posterior, memory), dim=1):
        products = posterior.products(part)
        about = noise.first_noise(products, posterior.count)
        places.append(torch.cat([part, about], dim=-1))
        densities.append(noise.log_density(products, posterior.count, about))
    return _Region.of(torch.cat(places, 1), torch.log_softmax(torch.cat(densities, 1), dim=1))


def _at_once(posterior: Posterior, memory: int) -> int:
    """Returns how many candidates of each driver are simulated at once."""
    return max(1, memory // (posterior.segments.problems * posterior.bytes_per_candidate))


def _density(posterior: Posterior, places: Tensor, memory: int) -> Tensor:
    """Returns the log density of places `(P, N, d)`, `(P, N)`."""
    parts = torch.split(places, _at_once(posterior, memory), dim=1)
    return torch.cat([posterior(part) for part in parts], dim=1)


def _learn_round(
    posterior: Posterior,
    region: _Region,
    before: list[_Round],
    generator: torch.Generator,
    memory: int,
) -> _Round:
    """Simulates what is drawn from a region, and has a flow learn from it.

    Args:
        posterior: of P drivers.
        region: of each.
        before: the rounds before; a flow goes on where the last one was.
        generator: of random numbers.
        memory: bound in bytes for what is simulated at once.
    """
    drivers, d = posterior.segments.problems, posterior.dimensions
    checked = -(-_CHECKED // drivers)
    count = min(max(SIMULATIONS // drivers, _LEAST), _MOST) + checked
    of_one = count * (_COPIES + 4) * posterior.bytes_per_candidate
    parts = []
    for some in torch.split(torch.arange(drivers), max(1, memory // of_one)):
        cut = _Region(*(values[some] for values in region))
        parts.append(_recordings(posterior.take(some), cut, count, generator))
    standard, read, observed = (torch.cat(values) for values in zip(*parts, strict=True))

    number = torch.arange(drivers, dtype=torch.float64)[:, None, None]
    x = torch.cat([number.expand(-1, read.shape[1], -1), read], dim=-1).float()
    theta = standard.float()
    # The first simulations of each driver, all their copies, are not learned from.
    aside = torch.arange(x.shape[1]) % count < checked
    learned = theta[:, ~aside].flatten(0, 1), x[:, ~aside].flatten(0, 1)
    kept = theta[:, aside][:, :checked].flatten(0, 1), x[:, aside][:, :checked].flatten(0, 1)
    with warnings.catch_warnings(), torch.enable_grad():
        warnings.simplefilter("ignore")  # that flows do not converge in a round's passes
        if before:
            flow = copy.deepcopy(before[-1].flow)
            build: Any = lambda *_: flow  # noqa: E731 - sbi asks for what builds it
        else:
            build = posterior_nn(
                "zuko_maf",
                z_score_theta="none",
                z_score_x="none",
                hidden_features=_HIDDEN,
                num_transforms=_TRANSFORMS,
                embedding_net=_Embedding(drivers, read.shape[-1]),
            )
        normal = torch.distributions.MultivariateNormal(torch.zeros(d), torch.eye(d))
        trainer = NPE(normal, build, show_progress_bars=False, tracker=_Silent())
        flow = trainer.append_simulations(*learned).train(
            training_batch_size=min(max(len(learned[0]) // _BATCHES, _LEAST_BATCH), _MOST_BATCH),
            learning_rate=_RATE,
            max_num_epochs=EPOCHS,
            stop_after_epochs=EPOCHS,
        )
    seen = torch.cat([number[:, 0], observed[:, 0]], dim=-1).float()
    return _Round(region, flow, trainer.build_posterior(flow), seen, kept)


def _recordings(
    posterior: Posterior, region: _Region, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Simulates recordings of drivers from a region.

    Returns:
        Standard coordinates `(P, q, d)`, what is read of each recording `(P, q, read)` and of the
        real one `(P, 1, read)`, in deviations of the former. A copy stands after the other.
    """
    drivers, n, order = posterior.segments.problems, len(posterior.space), posterior.order
    shape, steps = (count, posterior.dimensions), len(posterior.counted)
    drawn = []
    # One after the other, so that no driver's depend on how many are simulated at once.
    for _ in range(drivers):
        drawn.append(
            (
                torch.randn((_COPIES, *shape), generator=generator, dtype=torch.float64),
                torch.randn((steps, _COPIES * count), generator=generator, dtype=torch.float64),
            )
        )
    standard, white = (torch.stack(values) for values in zip(*drawn, strict=True))
    # Copies are of the same parameters.
    standard[..., :n] = standard[:, :1, :, :n].clone()
    first = standard[:, 0]
    errors = posterior.errors(region.outer(first)[..., :n]).nan_to_num().clamp(-1e3, 1e3)
    reader = _Reader.of(posterior, region, first[..., :n], errors)
    standard = standard.flatten(1, 2)
    of_noise = region.outer(standard)[..., n:]
    noisy = white.transpose(0, 1) * of_noise[..., -1].clamp(max=10.0).exp()
    phi = noise.coefficients(of_noise[..., :-1])
    for step in range(1, steps):
        for back in range(min(step, order)):
            noisy[step] += phi[..., back] * noisy[step - 1 - back]
    read = reader(errors.repeat(1, 1, _COPIES) - noisy)
    observed = reader(torch.zeros_like(errors[..., :1]))
    mean, deviation = read.mean(1, keepdim=True), read.std(1, keepdim=True) + 1e-9
    read, observed = (
        ((values - mean) / deviation).clamp(-_FAR, _FAR) for values in (read, observed)
    )
    return standard, read, observed
