"""Autoregressive noise: how the errors of a simulated trajectory hang together in time.

    e_t = phi_1 e_(t-1) + ... + phi_m e_(t-m) + s w_t,      w_t standard normal

The simulation starts from the measured state, so that errors before its first step are 0.

C. Zhang and L. Sun (2024), *Bayesian calibration of the intelligent driver model*, IEEE
Transactions on Intelligent Transportation Systems 25(8): errors of car-following models are
correlated over seconds, and who takes them for independent believes too much. Differences: errors
are of speed or gap in closed loop, and coefficients are kept stationary.

Shapes: `*batch` are any leading dimensions, m is the order, K steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

SHAPE, RATE = 1.0, 0.2**2
"""Prior of s squared: inverse gamma, as much as two steps with errors of 0.03 (m/s, or m) say. A
recording without noise so keeps a little of it."""

_LEAST_DENSITY = -1e12
"""Logarithm of the density where a simulation diverges: finite, so that slopes stay numbers."""


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
    found = values.clone()
    for k in range(phi.shape[-1]):
        found[k + 1 :] -= phi[..., k] * values[: -k - 1]
    return found


def prior_log_density(noise: Tensor) -> Tensor:
    """Returns the log density of the noise's parameters `(*batch, m + 1)` a priori, `(*batch,)`.

    It leaves constants out. Partial autocorrelations are uniform.
    """
    log_scale = noise[..., -1]
    uniform = uniform_log_density(noise[..., :-1])
    found: Tensor = uniform - 2.0 * SHAPE * log_scale - RATE * torch.exp(-2.0 * log_scale)
    return found


def uniform_log_density(squashed: Tensor) -> Tensor:
    """Returns the log density of squashed partial autocorrelations `(*batch, m)` a priori."""
    # log(1 - tanh(x)^2) without cancellation.
    size = squashed.abs()
    found: Tensor = 2.0 * (math.log(2.0) - size - softplus(-2.0 * size)).sum(-1)
    return found


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
    whole = torch.cat([torch.ones_like(phi[..., :1]), -phi], dim=-1)
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
    correlation = products[..., 0, 1] / products[..., 1, 1].clamp(min=1e-12)
    squashed = products.new_zeros((*products.shape[:-2], order))
    squashed[..., 0] = torch.atanh(correlation.clamp(-0.95, 0.999))
    shape, rate = scale_gamma(products, count, squashed)
    return torch.cat([squashed, 0.5 * (rate / shape).log()[..., None]], dim=-1)
