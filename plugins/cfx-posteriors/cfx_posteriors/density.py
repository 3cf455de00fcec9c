"""The posterior density of a driver's parameters and of the noise of their recording.

The likelihood belongs to the objective: errors of the gap where the objective reads the gap, else
of speed, in one closed loop from the measured state, with autoregressive noise. Coordinates are
without bounds: logits of parameters in unit space, then the noise's (`noise`).

Shapes: P drivers, q candidates, n tuned parameters, m the order of the noise, d = n + m + 1
coordinates, K steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from cfx.plugin import ComponentKey, ParameterSpace, SegmentLosses, Terms, squashed
from cfx_posteriors import noise

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
    found: Tensor = mean + normal @ torch.linalg.cholesky(covariance).mT
    return found


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
    def of(cls, space: ParameterSpace, name: Literal["weak", "chosen", "none"]) -> ParameterPrior:
        """Returns the prior that `calibration.prior` names.

        Weak: around the model's defaults. None: uniform between the bounds.
        """
        identity = torch.eye(len(space), dtype=torch.float64)
        if name == "none":
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
        found: Tensor = self.center.reshape(-1, n).mean(0) + normal * deviation
        return found

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
        order: m, of the noise.
        stride: simulated steps in each step of the noise: every so many frames count.
    """

    segments: SegmentLosses
    prior: ParameterPrior
    order: int
    stride: int = 1

    @property
    def space(self) -> ParameterSpace:
        """The model's parameter space."""
        return self.segments.stepper.model.space

    @property
    def dimensions(self) -> int:
        """D."""
        return len(self.space) + self.order + 1

    @property
    def signal(self) -> Literal["speed", "gap"]:
        """The signal whose errors count."""
        if "gap" in self.segments.objective.signals:
            return "gap"
        return "speed"

    @property
    def counted(self) -> Tensor:
        """1 for steps that count, `(K, P, 1)`."""
        return self.segments.segments.counted[self.stride - 1 :: self.stride, :, None]

    @property
    def count(self) -> Tensor:
        """The number of these steps, `(P, 1)`."""
        return self.counted.sum(0)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory of one candidate of one driver: its errors, some copies, and slopes of some."""
        return (self.segments.steps // self.stride + 1) * 16 * torch.float64.itemsize

    def take(self, drivers: Tensor) -> Posterior:
        """Returns the posterior of some drivers `(S,)` int64."""
        return replace(self, segments=self.segments.take(drivers), prior=self.prior.cut(drivers))

    @torch.no_grad()
    def errors(self, logits: Tensor) -> Tensor:
        """Returns errors `(K, P, q)` of parameters whose logits are `(P, q, n)`.

        They are 0 where they do not count.
        """
        p = self.segments.parameters(torch.sigmoid(logits))
        errors = SignalErrors(self.signal)
        terms = Terms(errors, ComponentKey(SignalErrors, self.signal))
        stepper = self.segments.stepper
        found = stepper.accumulate(self.segments.segments, p, terms, self.stride)
        if found is None:
            frames = self.segments.simulated(p, gap=self.signal == "gap")
            found = (errors(*frames[:4])[0][self.stride - 1 :: self.stride],)
        return torch.where(self.counted > 0, found[0], 0.0)

    def residual(self, place: Tensor) -> Tensor:
        """Returns what noise leaves of the errors of coordinates `(P, q, d)`, `(K, P, q)`."""
        n = len(self.space)
        errors = self.errors(place[..., :n])
        return noise.filtered(errors, noise.coefficients(place[..., n:-1])) * self.counted

    def __call__(self, place: Tensor) -> Tensor:
        """Returns the log density of coordinates `(P, q, d)`, `(P, q)`."""
        n = len(self.space)
        products = noise.lagged_products(self.errors(place[..., :n]), self.counted, self.order)
        likelihood = noise.log_density(products, self.count, place[..., n:])
        return likelihood + self.prior.log_density(place[..., :n])

    def with_slope(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the log density whatever the noise's scale, `(P, q)`, and its slope.

        Slopes of parameters are differences: any model has them.

        Args:
            place: coordinates but for the last, `(P, q, d - 1)`.
        """
        n = len(self.space)
        shift = DIFFERENCE * torch.eye(n, dtype=place.dtype)
        logits = place[..., None, :n] + torch.cat([torch.zeros_like(shift[:1]), shift])
        asked = logits.flatten(1, 2)
        products = noise.lagged_products(self.errors(asked), self.counted, self.order)
        products = products.view(*logits.shape[:3], *products.shape[-2:])
        with torch.enable_grad():
            own = place[..., None, n:].detach().requires_grad_()
            density = noise.marginal_log_density(products, self.count[..., None], own)
            (of_noise,) = torch.autograd.grad(density[..., 0].sum(), own)
        density = density.detach() + self.prior.log_density(asked).view_as(density)
        of_parameters = (density[..., 1:] - density[..., :1]) / DIFFERENCE
        return density[..., 0], torch.cat([of_parameters, of_noise[..., 0, :]], dim=-1)

    def draw_scales(self, place: Tensor, generator: torch.Generator) -> Tensor:
        """Returns the last coordinates, `(P, q, 1)`, as likely as the others `(P, q, d - 1)`."""
        n = len(self.space)
        products = noise.lagged_products(self.errors(place[..., :n]), self.counted, self.order)
        shape, rate = noise.scale_gamma(products, self.count, place[..., n:])
        gamma = torch._standard_gamma(shape.expand_as(rate).contiguous(), generator=generator)  # noqa: SLF001 - the only one with a generator
        return 0.5 * (rate / gamma).log()[..., None]
