"""The optimizer `gradient`: space-filling points, and local searches from the best.

J. Nocedal and S. J. Wright (2006), *Numerical Optimization*, second edition: BFGS (chapter 6),
finite differences (chapter 8), projection onto bounds (chapter 16).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from cfx.calibration.optimizers import (
    CandidateLosses,
    Tried,
    check_room,
    sobol,
)
from cfx.calibration.random_search import RandomSearch, RandomSettings
from cfx.core.component import Settings

_DIFFERENCE = 1e-6
"""The distance in unit space over which a slope is measured. Losses are exact to about 1e-14, so
rounding adds 1e-8 to a slope; piecewise smooth losses want a short distance."""

_SAMPLES_OF_SEARCH = 512
"""Samples for each local search, those of the screening included."""

_KEPT = 4
"""One search in this many is continued to its minimum."""

_LENGTHS = (3.0, 1.0, 0.5, 0.2, 0.05, 0.01)
"""Multiples of a step that are tried at once."""

_FIRST_RADIUS, _LARGEST_RADIUS, _SMALLEST_RADIUS = 0.1, 0.5, 1e-6
"""Length of one step in any coordinate of unit space."""


class GradientSettings(RandomSettings):
    """Settings of `GradientSearch`."""

    samples: int = Field(
        4096, ge=1, description="evaluations of each problem, slopes and guesses included"
    )
    screening: float = Field(
        0.75, gt=0.0, le=1.0, description="share of the samples that chooses where searches start"
    )
    starts: int | None = Field(
        None, ge=1, description="local searches of each problem; null: one for each 512 samples"
    )

    @model_validator(mode="after")
    def _enough(self) -> GradientSettings:
        if self.starts is not None and self.first < self.starts:
            raise ValueError(
                f"optimizer.starts={self.starts}: only {self.first} samples choose among;"
                " set fewer starts or more samples"
            )
        return self

    @property
    def first(self) -> int:
        """Samples that are evaluated first."""
        return max(1, int(self.samples * self.screening))

    @property
    def searches(self) -> int:
        """Local searches of each problem."""
        if self.starts is None:
            return max(1, min(self.samples // _SAMPLES_OF_SEARCH, self.first))
        return self.starts


class GradientSearch(RandomSearch):
    """Evaluates guesses and Sobol points, and searches locally from the best few.

    Each search is BFGS within the bounds. Slopes are differences towards the middle of the bounds,
    so any model and any simulator works. Six lengths of each step are tried at once: where
    simulation is batched this costs no more time than one. A step that finds nothing better starts
    again along the plain gradient, ten times shorter. All searches of all problems are one batch.

    More samples become more searches, not longer ones: models with regimes, such as Wiedemann's,
    have many local minima. A few steps show which searches are promising; the best quarter of them
    is continued to its minimum, with as many evaluations as all had before.

    Samples that are too few for another round become further Sobol points.
    """

    schema: ClassVar[type[Settings]] = GradientSettings
    settings: GradientSettings
    trial: ClassVar[Mapping[str, Any]] = {"samples": 512}

    def space_filling(self, n: int) -> int:
        return self.settings.first

    def bytes_per_problem(self, n: int) -> int:
        matrices = self.settings.searches * n * (4 * n + 20)
        return 8 * (self.evaluations(n) * (n + 2) + matrices)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tried, Tensor]:
        problems, g, n = guesses.shape
        settings = self.settings
        check_room(settings.first, g, key="samples")
        each_step = evaluations_of_round(n)
        stages, rest = _stages(settings.searches, settings.samples - settings.first, each_step)
        points = sobol(settings.first - g + rest, n, seed=seed, device=guesses.device)
        shared = points.expand(problems, -1, -1)
        tried, losses = [guesses, shared], [objective(guesses)]
        losses.append(objective(shared))
        search = _start(torch.cat(losses, dim=1), guesses, shared, settings.searches)
        for searches, rounds in stages:
            search = _best(search, searches)
            for _ in range(rounds):
                search, tried_now, losses_now = _round(search, objective)
                tried += tried_now
                losses += losses_now
        # The extra points stand before the searches, in the order of evaluation.
        return tuple(tried), torch.cat(losses, dim=1)


def descend(
    objective: CandidateLosses, points: Tensor, *, rounds: int, radius: float
) -> tuple[Tensor, Tensor]:
    """Searches locally from points `(P, S, n)`: returns where that leads, and the losses `(P, S)`.

    Each takes `1 + rounds * evaluations_of_round(n)` evaluations.

    Args:
        objective: losses of P problems.
        points: in unit space.
        rounds: steps of each search.
        radius: length of the first step in any coordinate.
    """
    search = _searches(points, objective(points), radius)
    for _ in range(rounds):
        search, _, _ = _round(search, objective)
    return search.point, search.loss


def evaluations_of_round(n: int) -> int:
    """Returns the evaluations that one step of a search of n parameters takes."""
    return n + len(_LENGTHS)


def _round(
    search: _LocalSearches, objective: CandidateLosses
) -> tuple[_LocalSearches, list[Tensor], list[Tensor]]:
    """Takes one step; returns the candidates that it tried too, and their losses."""
    around = _around(search.point)
    beside = objective(around.flatten(1, 2))
    search = _with_slope(search, around, beside.view(around.shape[:3]))
    steps = _steps(search)
    lower = objective(steps.flatten(1, 2))
    search = _stepped(search, steps, lower.view(steps.shape[:3]))
    return search, [around.flatten(1, 2), steps.flatten(1, 2)], [beside, lower]


def _stages(searches: int, samples: int, each_step: int) -> tuple[list[tuple[int, int]], int]:
    """Returns the stages, as searches of each problem and rounds, and the samples left over.

    All searches share the first half of the samples, and the best quarter of them the other one:
    few steps show which are promising, and these go on to their minimum.
    """
    stages = []
    if searches >= _KEPT:
        rounds = samples // (2 * searches * each_step)
        stages.append((searches, rounds))
        samples -= searches * rounds * each_step
        searches //= _KEPT
    rounds, rest = divmod(samples, searches * each_step)
    return [*stages, (searches, rounds)], rest


class _LocalSearches(NamedTuple):
    """S local searches of P problems.

    Attributes:
        point: `(P, S, n)`, where each stands.
        loss: `(P, S)`, there.
        slope: `(P, S, n)`, there; of the step before until it is measured anew.
        moved: `(P, S, n)`, the last step.
        inverse: `(P, S, n, n)`, estimate of the inverse second derivatives.
        fresh: `(P, S)` bool, nothing is known of the second derivatives.
        radius: `(P, S)`, how far a step may go.
    """

    point: Tensor
    loss: Tensor
    slope: Tensor
    moved: Tensor
    inverse: Tensor
    fresh: Tensor
    radius: Tensor


def _start(losses: Tensor, guesses: Tensor, shared: Tensor, starts: int) -> _LocalSearches:
    """Returns searches at the `starts` best points of each problem."""
    loss, index = losses.topk(starts, dim=1, largest=False)
    g, n = guesses.shape[1:]
    of_guess = guesses.gather(1, index.clamp(max=g - 1)[..., None].expand(-1, -1, n))
    if shared.shape[1]:
        place = (index - g).clamp(min=0)
        of_guess = of_guess.where((index < g)[..., None], shared[0][place])
    return _searches(of_guess, loss, _FIRST_RADIUS)


def _searches(point: Tensor, loss: Tensor, radius: float) -> _LocalSearches:
    """Returns searches that begin at points `(P, S, n)` with losses `(P, S)`."""
    nothing = torch.zeros_like(point)
    return _LocalSearches(
        point=point,
        loss=loss,
        slope=nothing,
        moved=nothing,
        inverse=_identity(point),
        fresh=torch.ones_like(loss, dtype=torch.bool),
        radius=torch.full_like(loss, radius),
    )


def _best(search: _LocalSearches, count: int) -> _LocalSearches:
    """Returns the searches of each problem that have come lowest."""
    if count == search.loss.shape[1]:
        return search
    index = search.loss.topk(count, dim=1, largest=False).indices
    chosen = []
    for value in search:
        places = index.view(*index.shape, *[1] * (value.dim() - 2))
        chosen.append(value.gather(1, places.expand(-1, -1, *value.shape[2:])))
    return _LocalSearches(*chosen)


def _identity(point: Tensor) -> Tensor:
    n = point.shape[-1]
    return torch.eye(n, dtype=point.dtype, device=point.device).expand(*point.shape, n).clone()


def _around(point: Tensor) -> Tensor:
    """Returns a point beside each in every coordinate, inside the bounds, `(P, S, n, n)`."""
    n = point.shape[-1]
    shift = torch.eye(n, dtype=point.dtype, device=point.device)
    inwards = torch.where(point > 0.5, -_DIFFERENCE, _DIFFERENCE)
    return point[:, :, None] + shift * inwards[:, :, None]


def _with_slope(search: _LocalSearches, around: Tensor, losses: Tensor) -> _LocalSearches:
    """Measures slopes, and learns the second derivatives from how they changed."""
    apart = torch.diagonal(around, dim1=-2, dim2=-1) - search.point
    slope = (losses - search.loss[:, :, None]) / apart
    slope = slope.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    inverse, fresh = _learned(search, slope)
    return search._replace(slope=slope, inverse=inverse, fresh=fresh)


def _learned(search: _LocalSearches, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the inverse after the BFGS update, where the last step says something."""
    s, y = search.moved[..., None], (slope - search.slope)[..., None]
    curvature = (s * y).sum((-2, -1))
    usable = curvature > 1e-12
    rho = (1.0 / curvature.where(usable, 1.0))[..., None, None]
    # The first estimate has the scale of the curvature along the step (Nocedal and Wright, 6.20).
    scale = (curvature / (y * y).sum((-2, -1)).clamp(min=1e-300)).where(search.fresh, 1.0)
    h = search.inverse * scale.where(usable, 1.0)[..., None, None]
    hy = h @ y
    # Both halves of the update, of which one is the other's transpose.
    half = s @ (rho * (0.5 * (1.0 + rho * (y.mT @ hy)) * s - hy)).mT
    updated = h + half + half.mT
    inverse = updated.where(usable[..., None, None], search.inverse)
    return inverse, search.fresh & ~usable


def _steps(search: _LocalSearches) -> Tensor:
    """Returns where steps of several lengths lead, `(P, S, lengths, n)`."""
    slope = search.slope
    blocked = ((search.point <= 0.0) & (slope > 0.0)) | ((search.point >= 1.0) & (slope < 0.0))
    free = slope.where(~blocked, 0.0)
    # The quasi-Newton step -H g (Nocedal and Wright, 6.2), along the bounds where they block it.
    newton = -(search.inverse @ free[..., None]).squeeze(-1).where(~blocked, 0.0)
    downhill = ((newton * free).sum(-1) < 0.0) & ~search.fresh
    step = newton.where(downhill[..., None], -free)
    longest = step.abs().amax(-1).clamp(min=1e-300)
    # Plain gradients have no scale: they go as far as they may.
    scale = search.radius / longest
    scale = torch.where(downhill, scale.clamp(max=1.0), scale)
    lengths = torch.tensor(_LENGTHS, dtype=step.dtype, device=step.device)
    moved = (step * scale[..., None])[:, :, None] * lengths[:, None]
    return (search.point[:, :, None] + moved).clamp(0.0, 1.0)


def _stepped(search: _LocalSearches, steps: Tensor, losses: Tensor) -> _LocalSearches:
    """Takes the best length of each step; where none is better, the next one is shorter."""
    lowest, index = losses.min(dim=2)
    n = steps.shape[-1]
    best = steps.gather(2, index[..., None, None].expand(-1, -1, 1, n)).squeeze(2)
    better = lowest < search.loss
    point = best.where(better[..., None], search.point)
    radius = torch.where(better, 2.0 * search.radius, 0.1 * search.radius)
    return search._replace(
        point=point,
        loss=lowest.where(better, search.loss),
        moved=point - search.point,
        inverse=search.inverse.where(better[..., None, None], _identity(point)),
        fresh=search.fresh | ~better,
        radius=radius.clamp(_SMALLEST_RADIUS, _LARGEST_RADIUS),
    )
