"""The optimizer `shade`: populations that search all problems at once, finished by gradients.

R. Tanabe and A. Fukunaga (2013), *Success-history based parameter adaptation for differential
evolution*, IEEE CEC; current-to-pbest/1 and its archive: J. Zhang and A. C. Sanderson (2009),
*JADE*, IEEE Transactions on Evolutionary Computation 13(5).

Shapes: P problems, S populations of each, N candidates of each population, A in its archive, n
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from cfx.calibration.gradient_search import GradientSearch, descend, evaluations_of_round
from cfx.calibration.optimizers import CandidateLosses, Optimizer, Tried, check_room, sobol
from cfx.core.component import Settings

_FIRST, _FIRST_SIZE = 4, 16
"""Populations that every problem has, and their candidates: small ones need the fewest evaluations
where the loss has few minima."""

_AGREE, _SAME = 3, 3e-3
"""So many of the first populations must end within this share of the loss of the best one, or the
search goes on: small populations often come to the same minimum that is not the lowest."""

_STAGES = 8, 4, 2
"""Populations of the long search, one stage after the other; each has a third of the evaluations,
and neighbours are merged in between. Many small populations come to more of the narrow valleys of
Gipps's and Wiedemann's losses, and large ones get to their bottom."""

_LONG_SIZE, _MERGED_SIZE = 32, 64
"""Candidates of each population of the long search, and of merged ones. A kernel takes 32."""

_LOW_POWER = 3
"""Every second population begins with points whose coordinates are raised to this power. Bounds are
wide, and what a driver does is often near the low end: a desired speed of 8 m/s between 1 and 70, a
deceleration of 0.4 m/s2 between 0.1 and 6. There even points are rare, and four populations that
begin with the same distribution agree on the same wrong minimum. The gap's excess over the best
known with SUMO's IDM, mean of 25 drivers and three seeds: 1.8 % without, 1.7 % with squares, 0.2 %
with the third power."""

_OF_FIRST, _OF_LONG = 300, 1400
"""Evaluations of one of the first populations, for each parameter, and of the long search, for each
pair of parameters, n^2. Measured by `python -m tests.benchmarks.optimum`."""

_CONVERGED, _GENERATIONS = 1e-3, 8
"""A population whose losses differ by less than this share has come to its end; so many generations
pass from one look to the next."""

_ROUNDS, _RADIUS = 6, 0.01
"""Steps of the gradient search from the best of each population, and the length of the first one in
any coordinate."""

_SCATTERED, _SCATTER_ROUNDS = 64, 16
"""Points about the best candidate of a population that a thorough search tries at once, and how
often at most."""

_SCATTER_SHARE = 5
"""A thorough search scatters at most one in so many of the evaluations of its long search."""

_NEAREST, _FARTHEST = 1e-5, 0.3
"""Distances of these points in any coordinate, log-uniform in between. Wiedemann's losses are
jagged: a driver switches a step sooner or later, and at a ten-thousandth of the range beside an
optimum the loss is 6 % higher in the median (w74, errors of the gap; IDM 0.0003 %). Slopes say
nothing there. In equal times the mean excess of w74 over the best that is known, for 25 pairs of
I-80 that the table in docs/speed.md leaves out, is 0.6 instead of 0.8 % (speed) and 1.5 instead of
2.9 % (gap)."""

_MEMORY = 6
"""Entries of the history of what succeeded (H of L-SHADE)."""

_BEST = 0.11
"""Share of a population that candidates move towards one of (p of L-SHADE)."""

_SPREAD = 0.1
"""Scale of the Cauchy and normal distributions that F and CR are drawn from (SHADE)."""


class ShadeSettings(Settings):
    """Settings of `ShadeSearch`."""

    samples: int | None = Field(
        None,
        ge=1,
        description="most evaluations of each problem; null: as many as its number of parameters"
        " asks for, times the model's `search_effort`. What is too few for the first populations"
        " goes to the gradient search alone; with more than the number of parameters asks for"
        " every problem is searched at length",
    )
    brief_samples: int = Field(
        4096,
        ge=1,
        description="evaluations of each window's label and of pooled parameters, by the gradient"
        " search; no more than samples",
    )
    pooled_samples: int | None = Field(
        None,
        ge=1,
        description="most evaluations of pooled parameters where populations search them too, such"
        " as 20000; null: the gradient search with brief_samples",
    )


class ShadeSearch(Optimizer):
    """Differential evolution whose steps adapt to what succeeded (SHADE), and a gradient search.

    Four small populations search each problem, two of them from points that are denser near the low
    ends of the bounds, and a gradient search goes on from the best of each.
    Where three end at the same loss, that is the optimum. Else eight others search at length, are
    merged by twos into four and two, and what these two come to is compared. All populations of
    all problems are one batch.

    Small populations can agree on a wide minimum that is not the lowest: with Newell's model on any
    desired speed that is never reached. So with more evaluations than usual, because the model
    declares it (`DrivingModel.search_effort`) or a user asks, agreement ends no search, and points
    scattered about the best are tried beside the gradient search.

    Random numbers are the same for every problem, made from the seed alone, and so are those of a
    stage whatever came before it; so a result does not depend on what is calibrated beside it.

    Differences from SHADE: F that would be negative is drawn once more and then reflected; CR has
    the Lehmer mean of L-SHADE; the first archive is the worse half of the first points, so that it
    is always full; populations do not shrink. Populations search in float32, since rounding by 1e-5
    does not mislead them, and gradients in float64.
    """

    schema: ClassVar[type[Settings]] = ShadeSettings
    settings: ShadeSettings
    trial: ClassVar[Mapping[str, Any]] = {"samples": 8000}
    in_threads = True

    def evaluations(self, n: int) -> int:
        plan = self._plan(n)
        if plan is None:
            return self._gradient(n).evaluations(n)
        return plan.evaluations

    def returned(self, n: int) -> int:
        plan = self._plan(n)
        if plan is None:
            return self._gradient(n).returned(n)
        return plan.first_points + _FIRST * _FIRST_SIZE + plan.kept + 2

    def evaluations_at_once(self, n: int) -> int:
        if self._plan(n) is None:
            return self._gradient(n).evaluations_at_once(n)
        return 2 * _STAGES[0] * _LONG_SIZE

    def space_filling(self, n: int) -> int:
        plan = self._plan(n)
        if plan is None:
            return self._gradient(n).space_filling(n)
        return plan.first_points

    def ends(self, n: int) -> int:
        return 0 if self._plan(n) is None else 2

    def brief(self) -> Optimizer:
        samples = self.settings.brief_samples
        if self.settings.samples is not None:
            samples = min(samples, self.settings.samples)
        return GradientSearch(samples=samples)

    def of_pooled(self) -> Optimizer:
        if self.settings.pooled_samples is None:
            return self.brief()
        return ShadeSearch(samples=self.settings.pooled_samples)

    def bytes_per_problem(self, n: int) -> int:
        if self._plan(n) is None:
            return self._gradient(n).bytes_per_problem(n)
        # Points, archives, five sets of candidates that a generation makes, and the local searches.
        return 8 * 2 * _STAGES[0] * _LONG_SIZE * (8 * n + 20) + 8 * _STAGES[0] * n * (4 * n + 20)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tried, Tensor]:
        problems, g, n = guesses.shape
        plan = self._plan(n)
        if plan is None:
            return self._gradient(n).solve(objective, guesses, seed=seed)
        check_room(plan.first_points, g, key="samples")
        points = sobol(
            plan.first_points - g + plan.long_points, n, seed=seed, device=guesses.device
        )
        points = _denser_at_low_ends(points, g)
        filling = points[: plan.first_points - g].expand(problems, -1, -1)
        first = torch.cat([guesses, filling], dim=1)
        losses = objective(first)
        begun = _begin(first, losses, _FIRST)
        draws = _Draws(seed, 0, guesses.device)
        searched = _evolved(begun, objective.rough(), plan.first_generations, draws)
        searched, searched_losses = _finished(searched, objective, draws)
        ends, order = searched.loss[:, :, 0].sort(dim=1, stable=True)
        last_population = searched.points.flatten(1, 2)
        best = searched.best.gather(1, order[..., None].expand(-1, -1, n))[:, :2]
        tried = [first, last_population]
        tried_losses = [losses, searched_losses]
        # What problems without a long search return in its place: their best candidate.
        later = best[:, :1].repeat(1, plan.kept, 1)
        later_losses = ends[:, :1].repeat(1, plan.kept)
        last, last_losses = best.clone(), ends[:, :2].clone()
        apart = ends[:, _AGREE - 1] - ends[:, 0]
        # Written so that infinite losses search on.
        searches_on = ~(apart <= _SAME * ends[:, 0].abs())
        if plan.thorough:
            searches_on = torch.ones_like(searches_on)
        open_ = searches_on.nonzero()[:, 0]
        if plan.stages and len(open_):
            these = objective.take(open_)
            long, long_losses = self._long(
                these, points[plan.first_points - g :], len(open_), seed, plan
            )
            later[open_], later_losses[open_] = long.points.flatten(1, 2), long_losses
            of_three = torch.cat([long.loss[:, :, 0], ends[open_, :1]], dim=1)
            lowest, order = of_three.sort(dim=1, stable=True)
            candidates = torch.cat([long.best, best[open_, :1]], dim=1)
            chosen = candidates.gather(1, order[..., None].expand(-1, -1, n))
            last[open_], last_losses[open_] = chosen[:, :2], lowest[:, :2]
        tried += [later, last]
        tried_losses += [later_losses, last_losses]
        return tuple(tried), torch.cat(tried_losses, dim=1)

    def _long(
        self, objective: CandidateLosses, points: Tensor, problems: int, seed: int, plan: _Plan
    ) -> tuple[_Populations, Tensor]:
        """Searches at length from points `(q, n)` that all problems share.

        Returns:
            The two last populations, and the losses of all their candidates.
        """
        shared = points.expand(problems, -1, -1)
        populations = _begin(shared, objective(shared), _STAGES[0])
        losses = populations.loss.flatten(1, 2)
        for number, generations in enumerate(plan.stages):
            if number:
                populations = _merged(populations, _STAGES[number])
            draws = _Draws(seed, 1 + number, points.device)
            populations = _evolved(populations, objective.rough(), generations, draws)
            populations, losses = _finished(populations, objective, draws, plan.scatter_rounds)
        return populations, losses

    def with_effort(self, times: float, n: int) -> Optimizer:
        if self.settings.samples is not None or times <= 1.0:
            return self
        samples = round(times * self.evaluations(n))
        return ShadeSearch(self.settings.model_copy(update={"samples": samples}))

    def _plan(self, n: int) -> _Plan | None:
        """Returns how evaluations are spent; None: by the gradient search alone."""
        usual, samples = _Plan.of(n, None), self.settings.samples
        if samples is None or samples == usual.evaluations:
            return usual
        alone = _Plan.of(n, 0)
        if samples < alone.evaluations:
            return None
        thorough = samples > usual.evaluations
        other = _Plan.of(n, samples - alone.evaluations, thorough=thorough)
        if not other.stages or other.evaluations > samples:
            return usual if thorough else alone
        return other

    def _gradient(self, n: int) -> GradientSearch:
        samples = self.settings.samples
        assert samples is not None, n
        return GradientSearch(samples=samples)


class _Plan(NamedTuple):
    """How the evaluations of a problem are spent.

    Attributes:
        first_points: that the first populations are chosen from.
        first_generations: of them.
        long_points: that the populations of the long search are chosen from.
        stages: generations of each stage of it; empty: there is none.
        evaluations: of all this.
        kept: candidates of the last populations of the long search.
        thorough: every problem is searched at length.
        scatter_rounds: how often points are scattered about the best of a population there.
    """

    first_points: int
    first_generations: int
    long_points: int
    stages: tuple[int, ...]
    evaluations: int
    kept: int
    thorough: bool = False
    scatter_rounds: int = 0

    @classmethod
    def of(cls, n: int, long: int | None, *, thorough: bool = False) -> _Plan:
        """Returns the plan for n parameters, with so many evaluations of the long search at most.

        Args:
            n: number of parameters.
            long: None: as many as n parameters ask for.
            thorough: see there.
        """
        first_points = 2 * _FIRST * _FIRST_SIZE
        generations = -(-_OF_FIRST * n // _FIRST_SIZE)
        spent = first_points + generations * _FIRST * _FIRST_SIZE
        spent += _FIRST * _finish_evaluations(n, _FIRST_SIZE)
        long_points, finishing = 2 * _STAGES[0] * _LONG_SIZE, 0
        for number, populations in enumerate(_STAGES):
            finishing += populations * _finish_evaluations(n, _size(number))
        budget = _OF_LONG * n * n if long is None else long
        scatter_rounds = 0
        if thorough:
            of_round = sum(_STAGES) * _SCATTERED
            scatter_rounds = min(_SCATTER_ROUNDS, budget // (_SCATTER_SHARE * of_round))
            finishing += scatter_rounds * of_round
        least = long_points + finishing
        if budget < 2 * least:
            return cls(first_points, generations, 0, (), spent, 1)
        stages = []
        for number, populations in enumerate(_STAGES):
            in_generation = populations * _size(number)
            stages.append(max(1, (budget - least) // (len(_STAGES) * in_generation)))
            spent += stages[-1] * in_generation
        merged = _STAGES[-1] * _MERGED_SIZE
        spent += least
        return cls(
            first_points,
            generations,
            long_points,
            tuple(stages),
            spent,
            merged,
            thorough,
            scatter_rounds,
        )


def _size(stage: int) -> int:
    """Returns the candidates of each population of a stage."""
    return _MERGED_SIZE if stage else _LONG_SIZE


def _finish_evaluations(n: int, size: int) -> int:
    """Returns the evaluations that `_finished` takes for one population."""
    return size + 1 + _ROUNDS * evaluations_of_round(n)


def _denser_at_low_ends(points: Tensor, place: int) -> Tensor:
    """Returns points `(q, n)`, of which those of every second population are nearer to 0.

    Args:
        points: in unit space.
        place: of the first one where points are dealt out to populations, see `_begin`.
    """
    number = torch.arange(place, place + len(points), device=points.device)
    return torch.where((number % 2 == 1)[:, None], points**_LOW_POWER, points)


class _Draws:
    """Random numbers of one stage, the same for every problem."""

    def __init__(self, seed: int, stage: int, device: torch.device) -> None:
        state = np.random.SeedSequence([seed, stage]).generate_state(2)
        self._generator = torch.Generator().manual_seed(int(state[0]) << 31 | int(state[1]) >> 1)
        self._device = device

    def uniform(self, *shape: int) -> Tensor:
        """Returns numbers in [0, 1), float64."""
        drawn = torch.rand(shape, generator=self._generator, dtype=torch.float64)
        return drawn.to(self._device)

    def below(self, count: int, *shape: int) -> Tensor:
        """Returns whole numbers from 0 to `count - 1`."""
        return (self.uniform(*shape) * count).long().clamp(max=count - 1)

    def cauchy(self, *shape: int) -> Tensor:
        """Returns numbers of the standard Cauchy distribution."""
        return torch.tan(math.pi * (self.uniform(*shape) - 0.5))

    def normal(self, *shape: int) -> Tensor:
        """Returns numbers of the standard normal distribution."""
        drawn = torch.randn(shape, generator=self._generator, dtype=torch.float64)
        return drawn.to(self._device)


class _Populations(NamedTuple):
    """S populations of P problems, each in the order of its losses.

    Attributes:
        points: `(P, S, N, n)`.
        loss: `(P, S, N)`.
        archive: `(P, S, A, n)`, candidates that were given up for better ones.
        scale: `(P, S, H)`, the history of F.
        crossover: `(P, S, H)`, the history of CR.
        place: `(P, S, 1)` int64, the entry of the history that is overwritten next.
    """

    points: Tensor
    loss: Tensor
    archive: Tensor
    scale: Tensor
    crossover: Tensor
    place: Tensor

    @property
    def best(self) -> Tensor:
        """`(P, S, n)`, the best candidate of each."""
        return self.points[:, :, 0]

    def take(self, problems: Tensor) -> _Populations:
        """Returns those of some problems."""
        return _Populations(*(values[problems] for values in self))


def _begin(points: Tensor, losses: Tensor, populations: int) -> _Populations:
    """Deals points `(P, q, n)` out to populations: the better half of each, the others' archive."""
    problems, count, n = points.shape
    each = count // populations
    dealt = points.view(problems, each, populations, n).transpose(1, 2)
    loss = losses.view(problems, each, populations).transpose(1, 2)
    dealt, loss = _sorted(dealt, loss)
    history = loss.new_full((problems, populations, _MEMORY), 0.5)
    return _Populations(
        points=dealt[:, :, : each // 2],
        loss=loss[:, :, : each // 2],
        archive=dealt[:, :, each // 2 :],
        scale=history,
        crossover=history.clone(),
        place=torch.zeros_like(history[..., :1], dtype=torch.int64),
    )


def _sorted(points: Tensor, loss: Tensor) -> tuple[Tensor, Tensor]:
    """Returns candidates `(P, S, N, n)` of each population in the order of losses `(P, S, N)`."""
    loss, order = loss.sort(dim=-1, stable=True)
    return points.gather(2, order[..., None].expand_as(points)), loss


def _merged(populations: _Populations, into: int) -> _Populations:
    """Merges neighbouring populations; the best `_MERGED_SIZE` candidates of each stay."""
    problems, _, _, n = populations.points.shape
    points, loss = _sorted(
        populations.points.reshape(problems, into, -1, n),
        populations.loss.reshape(problems, into, -1),
    )
    archive = populations.archive.reshape(problems, into, -1, n)
    histories = []
    for history in (populations.scale, populations.crossover):
        histories.append(history.view(problems, into, -1, _MEMORY).mean(2))
    return _Populations(
        points=points[:, :, :_MERGED_SIZE],
        loss=loss[:, :, :_MERGED_SIZE],
        archive=archive[:, :, :_MERGED_SIZE],
        scale=histories[0],
        crossover=histories[1],
        place=torch.zeros_like(populations.place[:, :into]),
    )


def _evolved(
    populations: _Populations, objective: CandidateLosses, generations: int, draws: _Draws
) -> _Populations:
    """Lets populations evolve, each problem until all its populations have converged."""
    whole = _Populations(*(values.clone() for values in populations))
    active = torch.arange(len(populations.loss), device=populations.loss.device)
    losses_of = objective
    for generation in range(1, generations + 1):
        populations = _next_generation(populations, losses_of, draws)
        if generation % _GENERATIONS and generation < generations:
            continue
        lowest, highest = populations.loss[..., 0], populations.loss[..., -1]
        done = (highest - lowest <= _CONVERGED * lowest.abs()).all(dim=1)
        if generation == generations:
            done = torch.ones_like(done)
        if bool(done.any()):
            for values, of_active in zip(whole, populations, strict=True):
                values[active[done]] = of_active[done]
            active, populations = active[~done], populations.take(~done)
            if not len(active):
                break
            losses_of = objective.take(active)
    return whole


def _next_generation(
    populations: _Populations, objective: CandidateLosses, draws: _Draws
) -> _Populations:
    """Tries one candidate beside each; the better of both stays."""
    points, loss, archive, history_f, history_cr, place = populations
    problems, count, size, n = points.shape
    archived = archive.shape[2]

    def at(candidates: Tensor, numbers: Tensor) -> Tensor:
        return candidates.gather(2, numbers[None, ..., None].expand(problems, -1, -1, n))

    entry = draws.below(_MEMORY, count, size).expand(problems, -1, -1)
    mean_f, mean_cr = history_f.gather(2, entry), history_cr.gather(2, entry)
    drawn = mean_f + _SPREAD * draws.cauchy(count, size)
    again = (mean_f + _SPREAD * draws.cauchy(count, size)).abs()
    f = drawn.where(drawn > 0, again).clamp(max=1.0)
    cr = (mean_cr + _SPREAD * draws.normal(count, size)).clamp(0.0, 1.0)
    # current-to-pbest/1: towards one of the best, and along the difference of two others.
    towards = draws.below(max(2, math.ceil(_BEST * size)), count, size)
    member = torch.arange(size, device=points.device)
    second = (member + 1 + draws.below(size - 1, count, size)) % size
    other = (member + 1 + draws.below(size + archived - 1, count, size)) % (size + archived)
    both = torch.cat([points, archive], dim=2)
    moved = at(points, towards) - points + at(points, second) - at(both, other)
    trial = points + f[..., None] * moved
    # Beyond a bound: half way to it.
    trial = torch.where(trial < 0.0, 0.5 * points, trial)
    trial = torch.where(trial > 1.0, 0.5 * (points + 1.0), trial)
    crossed = draws.uniform(count, size, n) < cr[..., None]
    always = draws.below(n, count, size)[..., None] == torch.arange(n, device=points.device)
    trial = trial.where(crossed | always, points)
    tried = objective(trial.flatten(1, 2)).view_as(loss)
    better = tried < loss
    history_f, history_cr, place = _remembered(populations, f, cr, tried, better)
    slots = draws.uniform(count, archived).argsort(dim=-1)[:, :size]
    slots = slots[None, ..., None].expand(problems, -1, -1, n)
    given_up = points.where(better[..., None], archive.gather(2, slots))
    archive = archive.scatter(2, slots, given_up)
    stays = tried <= loss
    points, loss = _sorted(trial.where(stays[..., None], points), tried.where(stays, loss))
    return _Populations(points, loss, archive, history_f, history_cr, place)


def _remembered(
    populations: _Populations, f: Tensor, cr: Tensor, tried: Tensor, better: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the histories of F and CR, and the next entry, after candidates were tried.

    Lehmer means of what succeeded, weighted by how much.
    """
    place = populations.place
    gain = (populations.loss - tried).where(better, 0.0)
    gain = gain.nan_to_num(posinf=torch.finfo(gain.dtype).max)
    most = gain.amax(dim=-1, keepdim=True)
    weight = gain / most.clamp(min=torch.finfo(gain.dtype).tiny)
    any_better = most > 0
    histories = []
    for history, values in ((populations.scale, f), (populations.crossover, cr)):
        first = (weight * values).sum(dim=-1, keepdim=True)
        second = (weight * values * values).sum(dim=-1, keepdim=True)
        mean = second / first.clamp(min=torch.finfo(first.dtype).tiny)
        mean = mean.where(any_better, history.gather(2, place))
        histories.append(history.scatter(2, place, mean))
    return histories[0], histories[1], (place + any_better.long()) % _MEMORY


def _finished(
    populations: _Populations,
    objective: CandidateLosses,
    draws: _Draws,
    scatter_rounds: int = 0,
) -> tuple[_Populations, Tensor]:
    """Measures losses exactly, and searches on by gradients from the best of each population.

    Args:
        populations: of P problems.
        objective: their losses.
        draws: random numbers of scattered points.
        scatter_rounds: how often such are tried about what gradients found.

    Returns:
        The populations with what was found in the place of the best candidate, and the losses of
        all their candidates, `(P, S N)`.
    """
    loss = objective(populations.points.flatten(1, 2)).view_as(populations.loss)
    points, loss = _sorted(populations.points, loss)
    best, lowest = descend(objective, points[:, :, 0], rounds=_ROUNDS, radius=_RADIUS)
    for _ in range(scatter_rounds):
        best, lowest = _scattered(best, lowest, objective, draws)
    points, loss = points.clone(), loss.clone()
    points[:, :, 0], loss[:, :, 0] = best, lowest
    return populations._replace(points=points, loss=loss), loss.flatten(1, 2)


def _scattered(
    best: Tensor, lowest: Tensor, objective: CandidateLosses, draws: _Draws
) -> tuple[Tensor, Tensor]:
    """Tries points about `(P, S, n)` of losses `(P, S)`, near and far; the better ones stay.

    About half of the coordinates of each point are moved, at least one.
    """
    _, count, n = best.shape
    decades = math.log(_FARTHEST / _NEAREST)
    distance = _NEAREST * torch.exp(decades * draws.uniform(count, _SCATTERED, 1))
    always = draws.below(n, count, _SCATTERED)[..., None] == torch.arange(n, device=best.device)
    moved = (draws.uniform(count, _SCATTERED, n) < 0.5) | always
    away = (distance * draws.normal(count, _SCATTERED, n)).where(moved, 0.0)
    points = (best[:, :, None] + away).clamp(0.0, 1.0)
    loss = objective(points.flatten(1, 2)).view(*best.shape[:2], _SCATTERED)
    least, index = loss.min(dim=2)
    nearest = points.gather(2, index[..., None, None].expand(-1, -1, 1, n)).squeeze(2)
    better = least < lowest
    return nearest.where(better[..., None], best), least.where(better, lowest)
