"""The unscented Kalman filter of a driver's parameters (`policy=ukf`).

S. J. Julier and J. K. Uhlmann (2004), *Unscented filtering and nonlinear estimation*, Proc. IEEE
92(3). E. A. Wan and R. van der Merwe (2000), *The unscented Kalman filter for nonlinear
estimation*, IEEE AS-SPCC, section 4 (parameter estimation).

Shapes: `*batch` any leading dimensions, n parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor

from cfx.plugin import History, ResidualSettings, Settings
from cfx_community.policies.estimator import (
    DrivenModel,
    EstimatorNetwork,
    EstimatorPolicy,
    bounded,
)

_JITTER = 1e-9
"""Added to the diagonal of a covariance before its root is taken."""


class FilterSettings(ResidualSettings):
    """Settings of filters of parameters; parameters are in the squashed space (logits)."""

    spread: float = Field(
        0.5,
        gt=0,
        le=10,
        description="standard deviation of a driver's parameters around the pooled ones",
    )
    drift: float = Field(
        0.02,
        ge=0,
        le=10,
        description="standard deviation by which parameters change within a second (process noise)",
    )
    noise: float = Field(
        2.0,
        gt=0,
        le=100,
        description="m/s2: standard deviation of a window's mean acceleration around the model's"
        " (measurement noise); what drivers do beyond the model lasts for several windows, so more"
        " than the error in a single one",
    )


class UkfPolicy(EstimatorPolicy):
    """An unscented Kalman filter estimates the driver's parameters while they are observed.

    The state is the parameters in the squashed space, a random walk with `drift`. The measurement
    of each window is its mean acceleration, simulated from the window's measured start with each of
    the 2 n + 1 sigma points. Once the policy drives, the mean is kept.

    Differences from the sources: the time update of a random walk is exact, so sigma points are
    drawn for the measurement only. A model with a memory begins each window with its initial one.
    """

    schema: ClassVar[type[Settings]] = FilterSettings
    settings: FilterSettings

    def estimator(
        self, driven: DrivenModel, prior: Tensor, generator: torch.Generator
    ) -> EstimatorNetwork:
        return UkfNetwork(driven, prior, self.settings)


class UkfNetwork(EstimatorNetwork):
    """Beliefs are the mean, n values, and the covariance, n n values row by row."""

    def __init__(self, driven: DrivenModel, prior: Tensor, settings: FilterSettings) -> None:
        super().__init__(driven, prior)
        self._settings = settings

    def initial_belief(self, prior: Tensor) -> Tensor:
        n = prior.shape[-1]
        covariance = self._settings.spread**2 * torch.eye(n, dtype=prior.dtype, device=prior.device)
        return torch.cat([prior, covariance.flatten().expand(*prior.shape[:-1], -1)], -1)

    def updated(self, history: History, belief: Tensor) -> Tensor:
        n = self.prior.shape[-1]
        mean, covariance = belief[..., :n], belief[..., n:].reshape(*belief.shape[:-1], n, n)
        seconds = self.driven.windows.stride * self.driven.dt
        drift = self._settings.drift**2 * seconds
        covariance = covariance + drift * torch.eye(n, dtype=mean.dtype, device=mean.device)
        mean, covariance = unscented_update(
            mean,
            covariance,
            lambda points: self.simulated_acceleration(history, bounded(points)),
            self.measured_acceleration(history),
            self._settings.noise**2,
        )
        return torch.cat([bounded(mean), covariance.flatten(-2)], -1)

    def estimate(self, belief: Tensor) -> Tensor:
        return belief[..., : self.prior.shape[-1]]


def unscented_update(
    mean: Tensor,
    covariance: Tensor,
    observe: Callable[[Tensor], Tensor],
    value: Tensor,
    variance: float,
) -> tuple[Tensor, Tensor]:
    """Updates Gaussian beliefs with one scalar measurement each.

    The sigma points are Julier and Uhlmann's with kappa = 3 - n, but at least 0:
    `mean +- columns of sqrt((n + kappa) covariance)`. Where `observe` is linear the result is the
    Kalman filter's.

    Args:
        mean: `(*batch, n)`.
        covariance: `(*batch, n, n)`.
        observe: the measurement that each point would give, `(*batch, k, n)` to `(*batch, k)`.
        value: what was measured, `(*batch,)`.
        variance: of the measurement's noise.

    Returns:
        Mean and covariance afterwards.
    """
    n = mean.shape[-1]
    kappa = max(0.0, 3.0 - n)
    identity = torch.eye(n, dtype=mean.dtype, device=mean.device)
    root, _ = torch.linalg.cholesky_ex(covariance + _JITTER * identity)
    away = math.sqrt(n + kappa) * root.transpose(-1, -2)
    points = torch.cat([torch.zeros_like(away[..., :1, :]), away, -away], -2)
    weights = mean.new_full((2 * n + 1,), 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    seen = observe(mean[..., None, :] + points)
    expected = (weights * seen).sum(-1)
    residuals = seen - expected[..., None]
    uncertainty = (weights * residuals.square()).sum(-1) + variance
    cross = (weights[:, None] * residuals[..., None] * points).sum(-2)
    gain = cross / uncertainty[..., None]
    mean = mean + gain * (value - expected)[..., None]
    correction = gain[..., :, None] * cross[..., None, :]
    covariance = covariance - 0.5 * (correction + correction.transpose(-1, -2))
    return mean, covariance
