"""Laplace's approximation: a normal distribution around the likeliest coordinates, and marginals.

The mode is found by Levenberg's and Marquardt's method, for all drivers at once. Errors are linear
in a small step of the parameters, which differences measure: any model will do. The covariance is
the inverse of the curvature that the search ends with (Gauss and Newton's: errors times second
derivatives are left out).

Where a recording bounds a parameter on one side only, as the desired speed in congestion, a normal
distribution is too narrow. So intervals come from marginals: at some values of each parameter the
others are sought anew, and the density there counts with the room that they have (Tierney and
Kadane). The covariance says how parameters hang together.

K. Levenberg (1944), *A method for the solution of certain non-linear problems in least squares*,
Quarterly of Applied Mathematics 2(2). L. Tierney and J. B. Kadane (1986), *Accurate approximations
for posterior moments and marginal densities*, Journal of the American Statistical Association
81(393).

Shapes: P drivers, S searches, n tuned parameters, m the order of the noise, d = n + m + 1, K steps,
G values of each parameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from cfx.calibration.posterior import noise
from cfx.calibration.posterior.density import Posterior

_ROUNDS, _ROUNDS_OF_MARGINALS = 60, 8
_DIFFERENCE = 1e-5
"""Distance in a logit over which slopes are measured."""

_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-9, 1e4
_LONGEST = 1.5
"""Longest step in one coordinate."""

_ENOUGH, _ENOUGH_OF_MARGINALS = 1e-3, 3e-2
"""Rise of the log density in one round below which a search has arrived."""

_NEAR = (-4.0, -2.2, -1.1, 0.0, 1.1, 2.2, 4.0)
"""Values of a parameter around its mode, in standard deviations."""

_FAR = (0.002, 0.1, 0.3, 0.5, 0.7, 0.9, 0.998)
"""Values by their quantiles a priori: G is the number of both."""

_FINE = 400
"""Places between the outermost values at which a marginal is integrated."""


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
        held: the coordinate that each leaves as it is, `(P, S)`; -1: none.
    """

    place: Tensor
    around: _Around
    damping: Tensor
    held: Tensor


def laplace(posterior: Posterior, starts: Tensor) -> Normal:
    """Returns the approximation around the likeliest place that a search finds.

    Args:
        posterior: of P drivers.
        starts: `(P, S, n)`, logits at which searches start.
    """
    errors = posterior.errors(starts)
    products = noise.lagged_products(errors, posterior.counted, posterior.order)
    place = torch.cat([starts, noise.first_noise(products, posterior.count)], dim=-1)
    held = torch.full(place.shape[:2], -1, device=place.device)
    found, settled = _searched(posterior, place, held, rounds=_ROUNDS, enough=_ENOUGH)
    best = found.around.value.argmax(dim=1)
    rows = torch.arange(len(best), device=best.device)
    factor = torch.linalg.cholesky(found.around.curvature[rows, best])
    return Normal(
        found.place[rows, best],
        torch.cholesky_inverse(factor),
        found.around.value[rows, best],
        settled[rows, best],
    )


def marginal_quantiles(posterior: Posterior, normal: Normal, shares: Tensor) -> Tensor:
    """Returns quantiles of each parameter's logit, `(P, len(shares), n)`.

    Args:
        posterior: of P drivers.
        normal: Laplace's approximation of it.
        shares: within (0, 1).
    """
    values = _values(posterior, normal)
    return _quantiles(values, _log_marginals(posterior, normal, values), shares)


def bytes_of_marginals(posterior: Posterior) -> int:
    """Returns the memory that `marginal_quantiles` needs for one driver."""
    n = len(posterior.space)
    searches = n * (len(_NEAR) + len(_FAR))
    needed: int = posterior.bytes_per_candidate * searches * (1 + n)
    return needed


def _values(posterior: Posterior, normal: Normal) -> Tensor:
    """Returns values of each logit at which its marginal is computed, in order, `(P, G, n)`."""
    n = len(posterior.space)
    mode = normal.mode[:, None, :n]
    deviation = torch.diagonal(normal.covariance, dim1=1, dim2=2)[:, None, :n].sqrt()
    near = torch.tensor(_NEAR, dtype=mode.dtype, device=mode.device)[:, None]
    shares = torch.tensor(_FAR, dtype=mode.dtype, device=mode.device)
    far = posterior.prior.quantiles(shares, n).expand(len(mode), -1, -1)
    return torch.cat([mode + deviation * near, far], dim=1).sort(dim=1).values


def _log_marginals(posterior: Posterior, normal: Normal, values: Tensor) -> Tensor:
    """Returns log densities of parameters at values `(P, G, n)`, up to a constant of each."""
    drivers, count, n = values.shape
    d = normal.mode.shape[-1]
    held = torch.arange(n, device=values.device).expand(drivers, count, n)
    # The others start where the normal distribution expects them, given the one.
    variance = torch.diagonal(normal.covariance, dim1=1, dim2=2)[:, :n, None]
    along = normal.covariance[:, :n] / variance
    away = (values - normal.mode[:, None, :n])[..., None]
    moved = away * along[:, None]
    # Far away that is no guide: no other coordinate moves further than the one.
    longest = moved.abs().amax(-1, keepdim=True)
    moved = moved * (away.abs() / longest.clamp(min=1e-9))
    place = normal.mode[:, None, None] + moved
    place.diagonal(dim1=2, dim2=3).copy_(values)
    found, _ = _searched(
        posterior,
        place.reshape(drivers, count * n, d),
        held.reshape(drivers, count * n),
        rounds=_ROUNDS_OF_MARGINALS,
        enough=_ENOUGH_OF_MARGINALS,
    )
    _, curvature = _free(found.around, found.held)
    room: Tensor = -0.5 * torch.linalg.slogdet(curvature).logabsdet
    density: Tensor = found.around.value + room
    return density.view(drivers, count, n)


def _quantiles(values: Tensor, log_density: Tensor, shares: Tensor) -> Tensor:
    """Returns quantiles `(P, len(shares), n)` of densities between values `(P, G, n)`."""
    known, height = values.cpu().numpy(), log_density.cpu().numpy()
    wanted = shares.cpu().numpy()
    drivers, _, n = known.shape
    found = np.empty((drivers, len(wanted), n))
    for driver in range(drivers):
        for column in range(n):
            found[driver, :, column] = _quantiles_of_one(
                known[driver, :, column], height[driver, :, column], wanted
            )
    return torch.as_tensor(found, device=values.device)


def _quantiles_of_one(
    values: NDArray[np.float64], height: NDArray[np.float64], shares: NDArray[np.float64]
) -> NDArray[np.float64]:
    values, first = np.unique(values, return_index=True)
    height = height[first]
    # Close where values are close: near the mode.
    place = np.interp(np.linspace(0, len(values) - 1, _FINE), np.arange(len(values)), values)
    density = np.exp(PchipInterpolator(values, height - height.max())(place))
    below = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(place))])
    quantiles: NDArray[np.float64] = np.interp(shares * below[-1], below, place)
    return quantiles


def _searched(
    posterior: Posterior, place: Tensor, held: Tensor, *, rounds: int, enough: float
) -> tuple[_Search, Tensor]:
    """Returns searches at their ends, and which have arrived, bool `(P, S)`."""
    now = _around(posterior, place)
    whole = _Search(place, now, torch.full_like(now.value, _DAMPING), held)
    settled = torch.zeros_like(held, dtype=torch.bool)
    left = torch.arange(len(place), device=place.device)
    part, search = posterior, whole
    for _ in range(rounds):
        search, arrived = _round(part, search, enough)
        whole.place[left] = search.place
        for kept, own in zip(whole.around, search.around, strict=True):
            kept[left] = own
        settled[left] |= arrived
        on = ~settled[left].all(dim=1)
        if not bool(on.any()):
            break
        if not bool(on.all()):  # drivers whose searches have all arrived are simulated no more
            left = left[on]
            part = posterior.take(left)
            around = _Around(*(values[on] for values in search.around))
            search = _Search(search.place[on], around, search.damping[on], search.held[on])
    return whole, settled


def _round(posterior: Posterior, search: _Search, enough: float) -> tuple[_Search, Tensor]:
    """Returns searches one step further, and which of them have arrived, bool `(P, S)`."""
    place, now, damping, held = search
    step = _step(search)
    tried = _around(posterior, place + step)
    rise = tried.value - now.value
    better = rise > 0.0
    arrived = (rise.abs() < enough) | (damping >= _MOST_DAMPING)
    place = torch.where(better[..., None], place + step, place)
    merged = []
    for new, old in zip(tried, now, strict=True):
        chosen = better.view(*better.shape, *[1] * (new.dim() - 2))
        merged.append(torch.where(chosen, new, old))
    damping = torch.where(better, 0.2 * damping, 5.0 * damping)
    damping = damping.clamp(_LEAST_DAMPING, _MOST_DAMPING)
    return _Search(place, _Around(*merged), damping, held), arrived


def _step(search: _Search) -> Tensor:
    slope, curvature = _free(search.around, search.held)
    diagonal = torch.diagonal(curvature, dim1=-2, dim2=-1)
    damped = curvature + torch.diag_embed(diagonal * search.damping[..., None])
    factor = torch.linalg.cholesky(damped)
    step = torch.cholesky_solve(slope[..., None], factor)[..., 0]
    longest = step.abs().amax(-1, keepdim=True)
    return step * (_LONGEST / longest.clamp(min=_LONGEST))


def _free(around: _Around, held: Tensor) -> tuple[Tensor, Tensor]:
    """Returns slope and curvature with those of held coordinates replaced by 0 and 1."""
    d = around.slope.shape[-1]
    number = torch.arange(d, device=held.device)
    free = (number != held[..., None]).to(around.slope)
    curvature = around.curvature * free[..., None] * free[..., None, :]
    return around.slope * free, curvature + torch.diag_embed(1.0 - free)


def _around(posterior: Posterior, place: Tensor) -> _Around:
    """Returns value, slope and curvature of the log density at places `(P, S, d)`."""
    n, order = len(posterior.space), posterior.order
    drivers, searches, d = place.shape
    logits = place[..., :n]
    shift = _DIFFERENCE * torch.eye(n, dtype=place.dtype, device=place.device)
    asked = torch.cat([logits[:, :, None], logits[:, :, None] + shift], dim=2)
    errors = posterior.errors(asked.flatten(1, 2)).view(-1, drivers, searches, 1 + n)
    middle = errors[..., 0]
    slopes = (errors[..., 1:] - errors[..., :1]) / _DIFFERENCE
    products = noise.lagged_products(middle, posterior.counted, order)
    value = noise.log_density(products, posterior.count, place[..., n:])
    value = value + posterior.prior.log_density(logits)

    squashed, log_scale = place[..., n:-1], place[..., -1]
    phi, turned = _coefficients_and_slopes(squashed)
    counted = posterior.counted
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
    slope[..., :n] += posterior.prior.slope(logits)
    slope[..., n:-1] -= 2.0 * squashed.tanh()
    weight = (squares + 2.0 * noise.RATE) * precision
    slope[..., -1] = weight - posterior.count - 2.0 * noise.SHAPE
    curvature = place.new_zeros((*place.shape, d))
    curvature[..., :-1, :-1] = gauss
    curvature[..., :n, :n] += posterior.prior.precision
    steps = torch.arange(n, n + order)
    curvature[..., steps, steps] += 2.0 * (1.0 - squashed.tanh().square())
    curvature[..., -1, -1] = 2.0 * weight
    return _Around(value, slope, curvature)


def _coefficients_and_slopes(squashed: Tensor) -> tuple[Tensor, Tensor]:
    """Returns coefficients `(P, S, m)` and their slopes `(P, S, m, m)`, by squashed partials."""
    with torch.enable_grad():
        wanted = squashed.detach().requires_grad_()
        phi = noise.coefficients(wanted)
        rows = []
        for k in range(phi.shape[-1]):
            (slope,) = torch.autograd.grad(phi[..., k].sum(), wanted, retain_graph=True)
            rows.append(slope)
    return phi.detach(), torch.stack(rows, dim=-2)
