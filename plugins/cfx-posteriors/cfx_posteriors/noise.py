"""Noise: where it enters, and how errors hang together in time.

A recording is predicted a step of the noise at a time (1 s, say). After each step the predicted
state moves towards the measured one by a share, the gain k, and drives on from there:

    e_t = predicted minus measured signal after step t
    state after step t = predicted + k (measured - predicted), of position and speed
    e_t = phi_1 e_(t-1) + ... + phi_m e_(t-m) + s w_t,      w_t standard normal

With k = 0 the prediction is one closed loop: errors are of the measurement, or of a trajectory that
keeps away from the measured one for a while. With k = 1 it starts anew from each measured state:
errors are what the driver's acceleration added within a step (their own action noise). Between
them both enter, and k says which share of an error is the driver's: it is the gain of the Kalman
filter in its steady state, and the model is in innovations form, whose errors are white where m and
k are right (L. Ljung 1999, *System identification*, 2nd ed., section 4.3; errors of the output and
of the equation are its two ends). One gain for position and speed is a simplification. Errors
before the first step are 0, since the simulation starts from the measured state.

C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent driver model*, IEEE
Transactions on Intelligent Transportation Systems 25(8): errors of car-following models are
correlated over seconds, and who takes them for independent believes too much. Theirs are errors of
the acceleration, k = 1 here. Differences: errors are of speed or gap after a step, not after each
frame, and coefficients are kept stationary.

Shapes: `*batch` are any leading dimensions, m is the order, K steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

SHAPE, RATE = 1.0, 0.03**2
"""Prior of s squared: inverse gamma, as much as two steps with errors of 0.03 (m/s, or m) say. A
recording without noise so keeps a little of it. With errors of 0.2 intervals of Krauss's drivers,
who correct an error of their acceleration in the next step, held 99 %."""

_LEAST_DENSITY = -1e12
"""Logarithm of the density where a simulation diverges: finite, so that slopes stay numbers."""


NOISE_KINDS = ("trajectory", "measurement", "acceleration", "both")
"""Of which `calibration.noise=chosen` takes the most evident one."""


class NoiseKind(NamedTuple):
    """Where noise enters.

    Attributes:
        name: as after `calibration.noise=`.
        gain: k; None: estimated.
        order: m; 0: white.
    """

    name: str
    gain: float | None
    order: int

    @property
    def simulated(self) -> int:
        """Coordinates besides the model's parameters that predictions depend on: those of k."""
        return int(self.gain is None)

    @property
    def log_constant(self) -> float:
        """What the densities of its parameters a priori leave out, for comparing kinds.

        Partial autocorrelations are uniform from -1 to 1.
        """
        return -self.order * math.log(2.0)


def noise_kind(name: str, order: int) -> NoiseKind:
    """Returns the kind of noise of a name, such as `acceleration`.

    Args:
        name: as after `calibration.noise=`, but for `chosen`.
        order: m, of kinds whose errors are autoregressive.
    """
    if name == "measurement":
        return NoiseKind(name, 0.0, 0)
    gains = {"trajectory": 0.0, "acceleration": 1.0, "both": None}
    return NoiseKind(name, gains[name], order)


def gain_after(gain: Tensor, step: int) -> Tensor:
    """Returns the gain after the t-th step, of the one that it comes to.

    The simulation starts from a state that was measured once. With k = 0 the gain is that of the
    mean of all measurements so far, 1 / (t + 1).
    """
    return gain + (1.0 - gain) / (step + 1)


def coefficients(squashed: Tensor) -> Tensor:
    """Returns coefficients phi `(*batch, m)` of noise from partial autocorrelations.

    Partial autocorrelations within (-1, 1) give stationary noise, and only they: Levinson's
    recursion (Monahan 1984, *A note on enforcing stationarity*, Biometrika 71(2)).

    Args:
        squashed: their inverse hyperbolic tangents, `(*batch, m)`.
    """
    partial = squashed.tanh()
    phi = partial[..., :1]
    for k in range(1, partial.shape[-1]):
        last = partial[..., k : k + 1]
        phi = torch.cat([phi - last * phi.flip(-1), last], dim=-1)
    return phi


def lagged_products(errors: Tensor, counted: Tensor, order: int) -> Tensor:
    """Returns the sums over time of e_(t-j) e_(t-k), `(*batch, m + 1, m + 1)`.

    Args:
        errors: `(K, *batch)`, 0 where they do not count.
        counted: 1 for steps that count, `(K, *batch)` or broadcasting to it.
        order: m.
    """
    lagged = []
    for lag in range(order + 1):
        shifted = torch.zeros_like(errors)
        shifted[lag:] = errors[: len(errors) - lag]
        lagged.append(shifted * counted)
    products = errors.new_empty((*errors.shape[1:], order + 1, order + 1))
    for j in range(order + 1):
        for k in range(j + 1):
            products[..., j, k] = (lagged[j] * lagged[k]).sum(0)
            products[..., k, j] = products[..., j, k]
    return products


def filtered(values: Tensor, phi: Tensor) -> Tensor:
    """Returns values minus what noise expects after those before them, `(K, *batch)`.

    Args:
        values: `(K, *batch)`.
        phi: coefficients, `(*batch, m)`.
    """
    innovations = values.clone()
    for k in range(phi.shape[-1]):
        innovations[k + 1 :] -= phi[..., k] * values[: -k - 1]
    return innovations


def prior_log_density(noise: Tensor) -> Tensor:
    """Returns the log density of the noise's parameters `(*batch, m + 1)` a priori, `(*batch,)`.

    It leaves constants out. Partial autocorrelations are uniform.
    """
    log_scale = noise[..., -1]
    uniform = uniform_log_density(noise[..., :-1])
    density: Tensor = uniform - 2.0 * SHAPE * log_scale - RATE * torch.exp(-2.0 * log_scale)
    return density


def uniform_log_density(squashed: Tensor) -> Tensor:
    """Returns the log density of squashed partial autocorrelations `(*batch, m)` a priori."""
    # log(1 - tanh(x)^2) without cancellation.
    size = squashed.abs()
    density: Tensor = 2.0 * (math.log(2.0) - size - softplus(-2.0 * size)).sum(-1)
    return density


def draw(count: int, order: int, generator: torch.Generator) -> Tensor:
    """Returns parameters of noise as they are a priori, `(count, m + 1)`."""
    uniform = torch.rand((count, order + 1), generator=generator, dtype=torch.float64)
    uniform = uniform.clamp(1e-12, 1.0 - 1e-12)
    gamma = -torch.log(uniform[:, -1:])  # of shape 1, which is `SHAPE`
    return torch.cat([torch.atanh(2.0 * uniform[:, :-1] - 1.0), 0.5 * (RATE / gamma).log()], dim=-1)


def scale_gamma(products: Tensor, count: Tensor, squashed: Tensor) -> tuple[Tensor, Tensor]:
    """Returns shape and rate of the gamma distribution that 1 / s^2 has, `(*batch,)` each.

    Given errors and correlations.

    Args:
        products: of `lagged_products`, `(*batch, m + 1, m + 1)`.
        count: steps that count, broadcasting to `(*batch,)`.
        squashed: `(*batch, m)`, as in `coefficients`.
    """
    phi = coefficients(squashed)
    whole = torch.cat([phi.new_ones((*phi.shape[:-1], 1)), -phi], dim=-1)
    squares = (whole[..., :, None] * products * whole[..., None, :]).sum((-2, -1))
    return 0.5 * count + SHAPE, 0.5 * squares + RATE


def log_density(products: Tensor, count: Tensor, noise: Tensor) -> Tensor:
    """Returns the log density of errors and of the noise's parameters, `(*batch,)`.

    It leaves constants out.

    Args:
        products, count: as of `scale_gamma`.
        noise: `(*batch, m + 1)`, as in `coefficients`, then the logarithm of s.
    """
    squashed, log_scale = noise[..., :-1], noise[..., -1]
    shape, rate = scale_gamma(products, count, squashed)
    total = uniform_log_density(squashed) - 2.0 * shape * log_scale
    total = total - rate * torch.exp(-2.0 * log_scale)
    return torch.where(total.isfinite(), total, _LEAST_DENSITY)


def marginal_log_density(products: Tensor, count: Tensor, squashed: Tensor) -> Tensor:
    """Returns the log density of errors and correlations, whatever s, `(*batch,)`.

    The integral of `log_density` over the logarithm of s, up to a constant.

    Args:
        products, count, squashed: as of `scale_gamma`.
    """
    shape, rate = scale_gamma(products, count, squashed)
    total = uniform_log_density(squashed) - shape * rate.log()
    return torch.where(total.isfinite(), total, _LEAST_DENSITY)


def first_noise(products: Tensor, count: Tensor) -> Tensor:
    """Returns noise that fits errors roughly: where a search starts, `(*batch, m + 1)`.

    Args:
        products, count: as of `scale_gamma`.
    """
    order = products.shape[-1] - 1
    squashed = products.new_zeros((*products.shape[:-2], order))
    if order:
        correlation = products[..., 0, 1] / products[..., 1, 1].clamp(min=1e-12)
        squashed[..., 0] = torch.atanh(correlation.clamp(-0.95, 0.999))
    shape, rate = scale_gamma(products, count, squashed)
    return torch.cat([squashed, 0.5 * (rate / shape).log()[..., None]], dim=-1)
