"""IDM with noise that remembers: what it leaves unexplained goes on for seconds.

IDM's pooled parameters are calibrated as cfx does; what measured accelerations differ from them, in
steps of half a second, is a Gaussian process in time whose next value depends on the last ones. The
two rivals differ in how they say that dependence.

Differences from the papers: parameters and noise are found one after the other, not by one Bayesian
inference, and are the same for all drivers.

Shapes: P pairs, p remembered steps. SI units.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import solve_toeplitz
from scipy.optimize import least_squares
from torch import Tensor

import cfx
from cfx.plugin import DrivingModel, Follower, Leader, PairBatch, PairSet, Settings, registry
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver

Floats = NDArray[np.float64]

STEP_S = 0.5
"""How long an acceleration holds."""

_BRAKES, _ACCELERATES = 8.0, 4.0
"""m/s2: what a car can do; a few measured gaps are so small that IDM asks for any braking."""


class Noise(NamedTuple):
    """What the next residual is, given the last p ones.

    Attributes:
        weights: of the last residuals, the latest first, `(p,)`.
        deviation: of what is new, m/s2.
    """

    weights: Floats
    deviation: float


class NoisyIdmSettings(Settings):
    """Settings of IDM with noise."""

    remembered: int = Field(5, ge=1, le=40, description="residuals that the next one depends on")
    optimizer: str = Field("shade", description="of cfx, which finds the pooled parameters")


class NoisyIdm(Rival):
    """Base of IDM with noise that remembers."""

    schema: ClassVar[type[Settings]] = NoisyIdmSettings
    settings: NoisyIdmSettings

    @abstractmethod
    def noise(self, covariances: Floats) -> Noise:
        """Returns the noise of residuals with these covariances at lags 0, 1, ..., p."""

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        chosen = self.settings.optimizer
        fit = cfx.calibrate(pairs, "idm", seed=seed, split=1.0, optimizer=chosen)
        model = cast(DrivingModel, registry.create("model", {"name": "idm"}))
        parameters = torch.tensor(fit.pooled.to_numpy(dtype=np.float64))
        idm = _Idm(model, parameters)
        covariances = _covariances(pairs, idm, self.settings.remembered)
        return NoisyIdmDriver(idm, self.noise(covariances), pairs.dt)


class ArIdm(NoisyIdm):
    """IDM with autoregressive noise; its weights are those of Yule and Walker's equations."""

    reference = (
        "Zhang, Wang and Sun (2024), Calibrating car-following models via Bayesian dynamic"
        " regression, Transp. Res. C"
    )

    def noise(self, covariances: Floats) -> Noise:
        return _given_covariances(covariances)


class MaIdm(NoisyIdm):
    """Memory-augmented IDM: noise with a squared-exponential kernel, fitted to covariances."""

    reference = (
        "Zhang and Sun (2024), Bayesian calibration of the intelligent driver model, IEEE Trans."
        " Intell. Transp. Syst. 25"
    )

    def noise(self, covariances: Floats) -> Noise:
        lags: Floats = STEP_S * np.arange(len(covariances), dtype=np.float64)

        def apart(logs: Floats) -> Floats:
            variance, scale, nugget = np.exp(logs).tolist()
            return _kernel(lags, variance, scale, nugget) - covariances

        start = np.log([0.9 * covariances[0], 1.5, 0.1 * covariances[0]])
        variance, scale, nugget = np.exp(least_squares(apart, start).x).tolist()
        return _given_covariances(_kernel(lags, variance, scale, nugget))


def _kernel(lags: Floats, variance: float, scale: float, nugget: float) -> Floats:
    """Returns a squared-exponential kernel with a nugget."""
    values = variance * np.exp(-0.5 * (lags / scale) ** 2)
    values[0] += nugget + 1e-6 * variance
    return values


def _given_covariances(covariances: Floats) -> Noise:
    """Returns the best linear prediction of the next value, and what remains of its variance."""
    weights = solve_toeplitz(covariances[:-1], covariances[1:])
    variance = covariances[0] - float(weights @ covariances[1:])
    return Noise(weights, float(np.sqrt(max(variance, 1e-8))))


class _Idm:
    """IDM's acceleration for any signals of one shape."""

    def __init__(self, model: DrivingModel, parameters: Tensor) -> None:
        self._model = model
        self._p = model.space.unpack(parameters)

    def acceleration(self, speed: Tensor, leader_speed: Tensor, gap: Tensor) -> Tensor:
        """Returns accelerations over the next half second, as the model sees it now."""
        nothing = torch.zeros_like(speed)
        follower = Follower(nothing, speed, nothing, self._model.initial_memory(speed))
        leader = Leader(gap, leader_speed, nothing, torch.zeros((), dtype=speed.dtype))
        changed = self._model.next_speed(follower, leader, self._p, STEP_S)
        return ((changed - speed) / STEP_S).clamp(-_BRAKES, _ACCELERATES)


def _covariances(pairs: PairSet, idm: _Idm, remembered: int) -> Floats:
    """Returns the covariances of what IDM leaves unexplained, at lags 0, 1, ..., p.

    Correlations are means over sites. Their variance is that of the site in the middle: where
    drivers keep far smaller gaps than with pooled parameters, residuals are offsets of several
    m/s2, and one such site would make the noise of all.
    """
    batch = PairBatch.of(pairs)
    every = round(STEP_S / batch.dt)
    speed = batch.follower_speed[:, ::every]
    counted = batch.mask[:, ::every][:, 1:]
    expected = idm.acceleration(speed, batch.leader_speed[:, ::every], batch.gap[:, ::every])
    residual = (speed.diff(dim=1) / STEP_S - expected[:, :-1]).numpy()
    usable = counted.numpy() & (batch.gap[:, ::every][:, :-1] > 0.0).numpy()
    residual = np.where(usable, residual, 0.0)
    sites = np.array([pair.site for pair in pairs])
    of_sites = []
    for site in np.unique(sites):
        rows = sites == site
        values, is_known = residual[rows], usable[rows]
        sums = []
        for lag in range(remembered + 1):
            both = is_known[:, lag:] & is_known[:, : is_known.shape[1] - lag]
            product = values[:, lag:] * values[:, : values.shape[1] - lag]
            # Divided by the same number at each lag, so that the matrix of them is positive.
            sums.append(float(product[both].sum()) / float(is_known.sum()))
        of_sites.append(sums)
    each = np.array(of_sites)
    correlations: Floats = (each / each[:, :1]).mean(0)
    return correlations * float(np.median(each[:, 0]))


class NoisyIdmDriver(StepDriver):
    """Drives by IDM with noise; where nothing is drawn, with the mean of the noise to come.

    The memory holds what IDM wanted the last time, and the last residuals, the latest first. A
    residual is what happened less what IDM wanted: of the measured past it is the driver's own.

    Args:
        idm: with pooled parameters.
        noise: of the residuals.
        dt: time step, s.
    """

    is_stochastic = True

    def __init__(self, idm: _Idm, noise: Noise, dt: float) -> None:
        self._idm = idm
        self._noise = noise
        self._weights = torch.tensor(noise.weights)
        self.every = round(STEP_S / dt)
        self.lags = self.every
        self.memory_s = STEP_S * (len(noise.weights) + 1)

    def begin(self, seen: Seen) -> Tensor:
        return seen.gap.new_zeros((len(seen.gap), 1 + len(self._weights)))

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        happened = seen.follower_acceleration.mean(1)
        latest = (happened - memory[:, 0])[:, None]
        residuals = torch.cat([latest, memory[:, 1:-1]], 1)
        wanted = self._idm.acceleration(
            seen.follower_speed[:, -1], seen.leader_speed[:, -1], seen.gap[:, -1]
        )
        following = torch.cat([wanted[:, None], residuals], 1)
        # What is known of the past goes on and fades, also where nothing is drawn: it is the mean.
        noise = residuals @ self._weights
        if generator is not None:
            draws = torch.randn(len(wanted), generator=generator, dtype=torch.float64)
            noise = noise + self._noise.deviation * draws
        return wanted + noise, following
