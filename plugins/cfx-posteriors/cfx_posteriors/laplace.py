"""Laplace's approximation: a normal distribution around the likeliest coordinates.

The mode is found by Levenberg's and Marquardt's method, for all drivers at once. Errors are linear
in a small step of the parameters, which differences measure: any model will do. The covariance is
the inverse of the curvature that the search ends with (Gauss and Newton's: errors times second
derivatives are left out). It is where samples start from (`importance`).

K. Levenberg (1944), *A method for the solution of certain non-linear problems in least squares*,
Quarterly of Applied Mathematics 2(2).

Shapes: P drivers, S searches, n tuned parameters, m the order of the noise, d = n + m + 1, K steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cfx_posteriors import noise
from cfx_posteriors.density import DIFFERENCE, Posterior

_SPREAD, _LIKELY = 512, 6
"""Places all over the prior that are tried, and as many of them as searches start from."""

_ROUNDS = 60
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-9, 1e4
_LONGEST = 1.5
"""Longest step in one coordinate."""

_ENOUGH = 1e-3
"""Rise of the log density in one round below which a search has arrived."""


class Normal(NamedTuple):
    """Normal distributions of P drivers' coordinates.

    Attributes:
        mode: `(P, d)`.
        covariance: `(P, d, d)`.
        log_density: at the mode, `(P,)`, as of `Posterior`.
        settled: bool `(P,)`, the search has arrived.
    """

    mode: Tensor
    covariance: Tensor
    log_density: Tensor
    settled: Tensor


class _Around(NamedTuple):
    """The density around places, `(P, S, ...)`."""

    value: Tensor
    slope: Tensor
    curvature: Tensor


class _Search(NamedTuple):
    """Searches `(P, S, ...)`.

    Attributes:
        place: where they stand.
        around: the density there.
        damping: of the next step.
    """

    place: Tensor
    around: _Around
    damping: Tensor


def laplace(posterior: Posterior, starts: Tensor) -> Normal:
    """Returns the approximation around the likeliest place that a search finds.

    Args:
        posterior: of P drivers.
        starts: `(P, S, n)`, logits at which searches start, with the gain's or without.
    """
    missing = posterior.simulated - starts.shape[-1]
    starts = torch.cat([starts, starts.new_zeros((*starts.shape[:-1], missing))], dim=-1)
    products = posterior.products(starts)
    place = torch.cat([starts, noise.first_noise(products, posterior.count)], dim=-1)
    search, settled = _searched(posterior, place)
    best = search.around.value.argmax(dim=1)
    rows = torch.arange(len(best), device=best.device)
    factor = torch.linalg.cholesky(search.around.curvature[rows, best])
    return Normal(
        search.place[rows, best],
        torch.cholesky_inverse(factor),
        search.around.value[rows, best],
        settled[rows, best],
    )


def log_evidence(posterior: Posterior, normal: Normal) -> Tensor:
    """Returns the logarithm of how likely recordings are, whatever parameters and noise, `(P,)`.

    Laplace's approximation of the integral of the density (R. E. Kass and A. E. Raftery 1995,
    *Bayes factors*, Journal of the American Statistical Association 90), up to a constant that is
    the same for all kinds of noise. Every kind predicts the same signal at the same times from what
    was measured before, so that they compare (A. P. Dawid 1984, *The prequential approach*, Journal
    of the Royal Statistical Society A 147).
    """
    size = torch.linalg.slogdet(normal.covariance).logabsdet
    volume = 0.5 * (size + posterior.dimensions * math.log(2.0 * math.pi))
    evidence: Tensor = normal.log_density + volume + posterior.kind.log_constant
    return evidence


def curvature(posterior: Posterior, place: Tensor) -> Tensor:
    """Returns the curvature of the log density (Gauss and Newton's), `(P, S, d, d)`.

    Args:
        posterior: of P drivers.
        place: coordinates, `(P, S, d)`.
    """
    return _around(posterior, place).curvature


def likely_starts(posterior: Posterior, seed: int) -> Tensor:
    """Returns the likeliest of some places all over the prior, `(P, S, s)`.

    A density may have several modes: a search from one place alone ends at the wrong one for 5 % of
    synthetic IDM drivers, with these for less than 2 of 100. The places are a Latin hypercube.

    Args:
        posterior: of P drivers.
        seed: of the places.
    """
    generator = torch.Generator().manual_seed(seed)
    shares = (torch.arange(_SPREAD, dtype=torch.float64) + 0.5) / _SPREAD
    places = posterior.prior_quantiles(shares).clone()
    for column in places.mT:
        column.copy_(column[torch.randperm(_SPREAD, generator=generator)])
    places = places.expand(posterior.segments.problems, -1, -1)
    products = posterior.products(places)
    about = noise.first_noise(products, posterior.count)
    density = noise.log_density(products, posterior.count, about)
    best = (density + posterior.prior_log_density(places)).topk(_LIKELY, dim=1).indices
    return places.gather(1, best[..., None].expand(-1, -1, places.shape[-1]))


def _searched(posterior: Posterior, place: Tensor) -> tuple[_Search, Tensor]:
    """Returns searches at their ends, and which have arrived, bool `(P, S)`."""
    now = _around(posterior, place)
    whole = _Search(place, now, torch.full_like(now.value, _DAMPING))
    settled = torch.zeros_like(now.value, dtype=torch.bool)
    left = torch.arange(len(place), device=place.device)
    part, search = posterior, whole
    for _ in range(_ROUNDS):
        search, arrived = _round(part, search)
        whole.place[left] = search.place
        for of_all, of_part in zip(whole.around, search.around, strict=True):
            of_all[left] = of_part
        settled[left] |= arrived
        on = ~settled[left].all(dim=1)
        if not bool(on.any()):
            break
        if not bool(on.all()):  # drivers whose searches have all arrived are simulated no more
            left = left[on]
            part = posterior.take(left)
            around = _Around(*(values[on] for values in search.around))
            search = _Search(search.place[on], around, search.damping[on])
    return whole, settled


def _round(posterior: Posterior, search: _Search) -> tuple[_Search, Tensor]:
    """Returns searches one step further, and which of them have arrived, bool `(P, S)`."""
    place, now, damping = search
    step = _step(search)
    tried = _around(posterior, place + step)
    rise = tried.value - now.value
    better = rise > 0.0
    arrived = (rise.abs() < _ENOUGH) | (damping >= _MOST_DAMPING)
    place = torch.where(better[..., None], place + step, place)
    merged = []
    for new, old in zip(tried, now, strict=True):
        chosen = better.view(*better.shape, *[1] * (new.dim() - 2))
        merged.append(torch.where(chosen, new, old))
    damping = torch.where(better, 0.2 * damping, 5.0 * damping)
    damping = damping.clamp(_LEAST_DAMPING, _MOST_DAMPING)
    return _Search(place, _Around(*merged), damping), arrived


def _step(search: _Search) -> Tensor:
    slope, curvature = search.around.slope, search.around.curvature
    diagonal = torch.diagonal(curvature, dim1=-2, dim2=-1)
    damped = curvature + torch.diag_embed(diagonal * search.damping[..., None])
    factor = torch.linalg.cholesky(damped)
    step = torch.cholesky_solve(slope[..., None], factor)[..., 0]
    longest = step.abs().amax(-1, keepdim=True)
    return step * (_LONGEST / longest.clamp(min=_LONGEST))


def _around(posterior: Posterior, place: Tensor) -> _Around:
    """Returns value, slope and curvature of the log density at places `(P, S, d)`."""
    n, order = posterior.simulated, posterior.order
    drivers, searches, d = place.shape
    logits = place[..., :n]
    shift = DIFFERENCE * torch.eye(n, dtype=place.dtype, device=place.device)
    beside = torch.cat([logits[:, :, None], logits[:, :, None] + shift], dim=2)
    errors = posterior.errors(beside.flatten(1, 2)).view(-1, drivers, searches, 1 + n)
    middle = errors[..., 0]
    slopes = (errors[..., 1:] - errors[..., :1]) / DIFFERENCE
    products = noise.lagged_products(middle, posterior.scored, order)
    value = noise.log_density(products, posterior.count, place[..., n:])
    value = value + posterior.prior_log_density(logits)

    squashed, log_scale = place[..., n:-1], place[..., -1]
    phi, turned = _coefficients_and_slopes(squashed)
    counted = posterior.scored
    residual = noise.filtered(middle, phi) * counted
    jacobian = torch.empty((*residual.shape, d - 1), dtype=place.dtype, device=place.device)
    for k in range(n):
        jacobian[..., k] = noise.filtered(slopes[..., k], phi) * counted
    lagged = torch.zeros((*middle.shape, order), dtype=place.dtype, device=place.device)
    for k in range(order):
        lagged[k + 1 :, ..., k] = middle[: -k - 1]
    # From coefficients to the coordinates that they are made of.
    jacobian[..., n:] = -torch.einsum("kpsi,psij->kpsj", lagged * counted[..., None], turned)
    precision = torch.exp(-2.0 * log_scale)
    rows = jacobian.permute(1, 2, 3, 0)
    gauss = rows @ rows.mT * precision[..., None, None]
    pulls = (rows @ residual.permute(1, 2, 0)[..., None])[..., 0] * precision[..., None]
    squares = residual.square().sum(0)

    slope = place.new_zeros(place.shape)
    slope[..., :-1] = -pulls
    slope[..., :n] += posterior.prior_slope(logits)
    slope[..., n:-1] -= 2.0 * squashed.tanh()
    weight = (squares + 2.0 * noise.RATE) * precision
    slope[..., -1] = weight - posterior.count - 2.0 * noise.SHAPE
    curvature = place.new_zeros((*place.shape, d))
    curvature[..., :-1, :-1] = gauss
    curvature[..., :n, :n] += posterior.prior_curvature(logits)
    steps = torch.arange(n, n + order)
    curvature[..., steps, steps] += 2.0 * (1.0 - squashed.tanh().square())
    curvature[..., -1, -1] = 2.0 * weight
    return _Around(value, slope, curvature)


def _coefficients_and_slopes(squashed: Tensor) -> tuple[Tensor, Tensor]:
    """Returns coefficients `(P, S, m)` and their slopes `(P, S, m, m)`, by squashed partials."""
    if squashed.shape[-1] == 0:
        return squashed, squashed.new_zeros((*squashed.shape, 0))
    with torch.enable_grad():
        wanted = squashed.detach().requires_grad_()
        phi = noise.coefficients(wanted)
        rows = []
        for k in range(phi.shape[-1]):
            (slope,) = torch.autograd.grad(phi[..., k].sum(), wanted, retain_graph=True)
            rows.append(slope)
    return phi.detach(), torch.stack(rows, dim=-2)
