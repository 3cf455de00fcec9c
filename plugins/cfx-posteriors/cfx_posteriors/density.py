"""The posterior density of a driver's parameters and of the noise of their recording.

The likelihood belongs to the objective: errors of the gap where the objective reads the gap, else
of speed, of what is predicted a step of the noise at a time (`noise`). Coordinates are without
bounds: logits of parameters in unit space, then the noise's: the logit of its gain where that is
estimated, squashed partial autocorrelations, the logarithm of the scale.

Shapes: P drivers, q candidates, n tuned parameters, s = n, or n + 1 with a gain, what is simulated,
m the order of the noise, d = s + m + 1 coordinates, K steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from cfx.plugin import (
    ComponentKey,
    ParameterSpace,
    SegmentLosses,
    Terms,
    squashed,
)
from cfx_posteriors import noise
from cfx_posteriors.noise import NoiseKind
from cfx_posteriors.prediction import Predictor

DEVIATION = 1.5
"""Standard deviation of a weak prior on each logit. A parameter whose default is in the middle is
between 0.08 and 0.92 of its range with 90 %."""


DIFFERENCE = 1e-5
"""Distance in a logit over which slopes are measured."""


@dataclass(frozen=True)
class SignalErrors:
    """Simulated minus measured, of one signal.

    Attributes:
        signal: speed (m/s) or gap (m).
    """

    signal: Literal["speed", "gap"]

    def __call__(
        self, speed: Tensor, gap: Tensor, measured_speed: Tensor, measured_gap: Tensor
    ) -> tuple[Tensor]:
        """Returns the error of each frame."""
        if self.signal == "gap":
            return (gap - measured_gap,)
        return (speed - measured_speed,)


def normal_draws(
    mean: Tensor, covariance: Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Returns draws `(count, n)` of a normal distribution with a mean `(n,)`."""
    normal = torch.randn((count, len(mean)), generator=generator, dtype=torch.float64)
    draws: Tensor = mean + normal @ torch.linalg.cholesky(covariance).mT
    return draws


@dataclass(frozen=True)
class ParameterPrior:
    """A prior on the logits of parameters in unit space.

    Attributes:
        center: of normal distributions, `(n,)`, or `(P, 1, n)` where drivers differ; None: uniform
            between the bounds.
        precision: the inverse covariance, `(n, n)`.
    """

    center: Tensor | None
    precision: Tensor

    @classmethod
    def of(cls, space: ParameterSpace, prior: str | float) -> ParameterPrior:
        """Returns the prior of `calibration.prior`.

        None: uniform between the bounds. Else around the model's defaults; how strongly they draw
        the point estimates changes nothing here.
        """
        identity = torch.eye(len(space), dtype=torch.float64)
        if prior == "none":
            # The curvature of a logistic distribution at its middle.
            return cls(None, 0.5 * identity)
        center = squashed(space.to_unit(space.defaults()))
        return cls(center, identity / DEVIATION**2)

    def log_density(self, logits: Tensor) -> Tensor:
        """Returns the log density of logits `(P, q, n)`, `(P, q)`, up to a constant."""
        if self.center is None:
            logistic = logits - 2.0 * torch.nn.functional.softplus(logits)
            return logistic.sum(-1)
        away = logits - self.center
        density: Tensor = -0.5 * ((away @ self.precision) * away).sum(-1)
        return density

    def slope(self, logits: Tensor) -> Tensor:
        """Returns the slope of the log density, `(P, q, n)`."""
        if self.center is None:
            return 1.0 - 2.0 * torch.sigmoid(logits)
        return -(logits - self.center) @ self.precision

    def quantiles(self, shares: Tensor, n: int) -> Tensor:
        """Returns quantiles of each logit a priori, `(len(shares), n)`."""
        if self.center is None:
            return torch.logit(shares)[:, None].expand(-1, n)
        normal = torch.special.ndtri(shares)[:, None]
        deviation = torch.linalg.inv(self.precision).diagonal().sqrt()
        values: Tensor = self.center.reshape(-1, n).mean(0) + normal * deviation
        return values

    def draw(self, drivers: int, n: int, *, seed: int) -> Tensor:
        """Returns logits of drivers before their recordings, `(drivers, n)`."""
        generator = torch.Generator().manual_seed(seed)
        if self.center is None:
            places = torch.rand((drivers, n), generator=generator, dtype=torch.float64)
            return torch.logit(places, eps=1e-12)
        return normal_draws(self.center, torch.linalg.inv(self.precision), drivers, generator)

    def cut(self, drivers: Tensor) -> ParameterPrior:
        """Returns the prior of some drivers."""
        if self.center is None or self.center.dim() == 1:
            return self
        return replace(self, center=self.center[drivers])


@dataclass(frozen=True)
class Posterior:
    """The posterior density of P drivers, up to a constant of each.

    Attributes:
        segments: the recordings, one segment each, and what simulates them.
        prior: of the parameters.
        kind: of the noise.
        stride: simulated steps in each step of the noise: every so many frames count.
    """

    segments: SegmentLosses
    prior: ParameterPrior
    kind: NoiseKind
    stride: int = 1

    @property
    def space(self) -> ParameterSpace:
        """The model's parameter space."""
        return self.segments.stepper.model.space

    @property
    def order(self) -> int:
        """M, of the noise."""
        return self.kind.order

    @property
    def simulated(self) -> int:
        """S."""
        return len(self.space) + self.kind.simulated

    @property
    def dimensions(self) -> int:
        """D."""
        return self.simulated + self.order + 1

    @property
    def signal(self) -> Literal["speed", "gap"]:
        """The signal whose errors count."""
        if "gap" in self.segments.objective.signals:
            return "gap"
        return "speed"

    @property
    def power(self) -> float:
        """The power of the likelihood, which the model declares."""
        return self.segments.stepper.model.likelihood_power

    @property
    def counted(self) -> Tensor:
        """1 for steps that count, `(K, P, 1)`."""
        return self.segments.segments.counted[self.stride - 1 :: self.stride, :, None]

    @property
    def scored(self) -> Tensor:
        """The same without the first one, times the root of the likelihood's power, `(K, P, 1)`.

        The simulation starts from a measured state, which is as wrong as any other. Models that
        forget it within a step have an error after the first that says nothing of the noise's
        innovations, those that remember have hardly any: the density is of all errors given the
        first. Scored too, intervals of Krauss's t_r held 82 instead of 88 %.

        Models with regimes do not forget it: see `power`. Products of two
        errors, which the likelihood is made of, have the power as their weight. It is a coarsened
        posterior (J. W. Miller and D. B. Dunson 2019, *Robust Bayesian inference via coarsening*,
        Journal of the American Statistical Association 114).
        """
        scored = self.counted.clone()
        scored[0] = 0.0
        return scored * math.sqrt(self.power)

    @property
    def count(self) -> Tensor:
        """The number of scored steps times the likelihood's power, `(P, 1)`."""
        return self.scored.square().sum(0)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory of one candidate of one driver: its errors, some copies, and slopes of some."""
        return (self.segments.steps // self.stride + 1) * 16 * torch.float64.itemsize

    def take(self, drivers: Tensor) -> Posterior:
        """Returns the posterior of some drivers `(S,)` int64."""
        return replace(self, segments=self.segments.take(drivers), prior=self.prior.cut(drivers))

    def gain(self, place: Tensor) -> Tensor | None:
        """Returns the gain at coordinates `(P, q, s)` or more, `(P, q)`; None: of a closed loop."""
        if self.kind.gain is None:
            return torch.sigmoid(place[..., len(self.space)]).contiguous()
        if self.kind.name == "trajectory":
            return None
        return place.new_full(place.shape[:2], self.kind.gain)

    @torch.no_grad()
    def errors(self, place: Tensor) -> Tensor:
        """Returns errors `(K, P, q)` at coordinates `(P, q, s)`, or more, which are not read.

        They are 0 where they do not count.
        """
        p = self.segments.parameters(torch.sigmoid(place[..., : len(self.space)]))
        gain = self.gain(place)
        errors = SignalErrors(self.signal)
        terms = Terms(errors, ComponentKey(SignalErrors, self.signal))
        stepper = self.segments.stepper
        accumulated = stepper.accumulate(self.segments.segments, p, terms, self.stride, gain)
        if accumulated is None and gain is None:
            frames = self.segments.simulated(p, gap=self.signal == "gap")
            accumulated = (errors(*frames[:4])[0][self.stride - 1 :: self.stride],)
        elif accumulated is None:
            accumulated = (self._predicted(place),)
        return torch.where(self.counted > 0, accumulated[0], 0.0)

    def predictor(self, place: Tensor) -> Predictor:
        """Returns what predicts recordings at coordinates `(P, q, s)`, or more, step by step."""
        p = self.segments.parameters(torch.sigmoid(place[..., : len(self.space)]))
        shape = place.shape[:2]
        p = {name: value.expand(shape) for name, value in p.items()}
        return Predictor(self.segments, p, self.gain(place), self.stride, self.signal)

    def _predicted(self, place: Tensor) -> Tensor:
        """Returns errors of predictions that are corrected after each step, `(K, P, q)`."""
        predictor, errors = self.predictor(place), []
        for _ in range(self.segments.steps // self.stride):
            predicted, measured = predictor.advance()
            error = predicted - measured
            errors.append(error)
            predictor.correct(error, torch.ones_like(error, dtype=torch.bool))
        return torch.stack(errors)

    def residual(self, place: Tensor) -> Tensor:
        """Returns what noise leaves of the errors of coordinates `(P, q, d)`, `(K, P, q)`."""
        phi = noise.coefficients(place[..., self.simulated : -1])
        return noise.filtered(self.errors(place), phi) * self.scored

    def products(self, place: Tensor) -> Tensor:
        """Returns sums of lagged products of errors at coordinates `(P, q, s)`, or more.

        `(P, q, m + 1, m + 1)`.
        """
        return noise.lagged_products(self.errors(place), self.scored, self.order)

    def __call__(self, place: Tensor) -> Tensor:
        """Returns the log density of coordinates `(P, q, d)`, `(P, q)`."""
        products = self.products(place)
        likelihood = noise.log_density(products, self.count, place[..., self.simulated :])
        return likelihood + self.prior_log_density(place)

    def likelihood(self, place: Tensor) -> Tensor:
        """Returns the log likelihood whatever the noise's scale, `(P, q)`.

        With the density a priori of what is no parameter of the model: gain and correlations.

        Args:
            place: coordinates but for the last, `(P, q, d - 1)`.
        """
        products = self.products(place)
        of_noise = place[..., self.simulated :]
        likelihood = noise.marginal_log_density(products, self.count, of_noise)
        return likelihood + self._gain_log_density(place)

    def prior_log_density(self, place: Tensor) -> Tensor:
        """Returns the log density a priori of coordinates `(P, q, s)`, or more, `(P, q)`.

        That of the noise's coordinates but for the gain is left out.
        """
        parameters = place[..., : len(self.space)]
        return self.prior.log_density(parameters) + self._gain_log_density(place)

    def _gain_log_density(self, place: Tensor) -> Tensor:
        """Returns that of the gain, which is uniform, `(P, q)`; 0 where none is estimated."""
        gain = place[..., len(self.space) : self.simulated]
        density: Tensor = (gain - 2.0 * torch.nn.functional.softplus(gain)).sum(-1)
        return density

    def prior_slope(self, place: Tensor) -> Tensor:
        """Returns the slope of it by coordinates `(P, q, s)`, or more, `(P, q, s)`."""
        n = len(self.space)
        gain = place[..., n : self.simulated]
        return torch.cat(
            [self.prior.slope(place[..., :n]), 1.0 - 2.0 * torch.sigmoid(gain)], dim=-1
        )

    def prior_curvature(self, place: Tensor) -> Tensor:
        """Returns minus the second derivatives of it, `(P, q, s, s)`."""
        n, s = len(self.space), self.simulated
        curvature = place.new_zeros((*place.shape[:2], s, s))
        curvature[..., :n, :n] = self.prior.precision
        share = torch.sigmoid(place[..., n:s])
        curvature[..., n:, n:] = torch.diag_embed(2.0 * share * (1.0 - share))
        return curvature

    def prior_deviation(self) -> Tensor:
        """Returns standard deviations of coordinates a priori, `(s,)`."""
        deviation = torch.linalg.inv(self.prior.precision).diagonal().sqrt()
        # That of a logistic distribution.
        gain = torch.full((self.kind.simulated,), math.pi / math.sqrt(3.0), dtype=torch.float64)
        return torch.cat([deviation, gain])

    def prior_quantiles(self, shares: Tensor) -> Tensor:
        """Returns quantiles of each coordinate a priori, `(len(shares), s)`."""
        quantiles = self.prior.quantiles(shares, len(self.space))
        gain = torch.logit(shares)[:, None].expand(-1, self.kind.simulated)
        return torch.cat([quantiles, gain], dim=-1)

    def prior_draw(self, count: int, *, seed: int) -> Tensor:
        """Returns coordinates of drivers before their recordings, `(count, s)`."""
        logits = self.prior.draw(count, len(self.space), seed=seed)
        generator = torch.Generator().manual_seed(seed + 1)
        gain = torch.rand((count, self.kind.simulated), generator=generator, dtype=torch.float64)
        return torch.cat([logits, torch.logit(gain, eps=1e-12)], dim=-1)

    def with_slope(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the log density whatever the noise's scale, `(P, q)`, and its slope.

        Slopes are differences: any model has them, and autograd would take as long for the noise's
        few coordinates as the kernel takes to simulate all candidates.

        Args:
            place: coordinates but for the last, `(P, q, d - 1)`.
        """
        s, e = self.simulated, place.shape[-1]
        # One candidate where it is, and one beside it in each coordinate: (P, q, 1 + e, e).
        shift = DIFFERENCE * torch.eye(e, dtype=place.dtype)
        moved = place[..., None, :] + torch.cat([torch.zeros_like(shift[:1]), shift])
        # Those beside it in a coordinate of the noise have its errors, so they are not simulated.
        simulated = moved[..., : 1 + s, :].flatten(1, 2)
        products = self.products(simulated)
        products = products.view(*place.shape[:2], 1 + s, *products.shape[-2:])
        unmoved = products[:, :, :1].expand(-1, -1, e - s, -1, -1)
        likelihood = noise.marginal_log_density(
            torch.cat([products, unmoved], dim=2), self.count[..., None], moved[..., s:]
        )
        density = likelihood + self.prior_log_density(moved.flatten(1, 2)).view_as(likelihood)
        slope = (density[..., 1:] - density[..., :1]) / DIFFERENCE
        return density[..., 0], slope

    def draw_scales(self, place: Tensor, generator: torch.Generator) -> Tensor:
        """Returns the last coordinates, `(P, q, 1)`, as likely as the others `(P, q, d - 1)`."""
        products = self.products(place)
        shape, rate = noise.scale_gamma(products, self.count, place[..., self.simulated :])
        gamma = torch._standard_gamma(shape.expand_as(rate).contiguous(), generator=generator)  # noqa: SLF001 - the only one with a generator
        return 0.5 * (rate / gamma).log()[..., None]
