"""Shards of a calibration for an engine: problems with the trajectories that they need.

A shard holds whatever its solution depends on, and nothing else. It is solved in the same way in
this process, in another one and on another machine.

Shapes: P pairs of a shard, T frames of the longest, W windows, K groups, n tuned parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from cfx.calibration.cache import Arrays
from cfx.calibration.losses import PooledLosses, Prior, SegmentLosses, TrajectorySegments
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import Optimizer, Solution
from cfx.calibration.rmse import SpeedRmse
from cfx.core import registry
from cfx.core.component import content_key, folder_hash
from cfx.core.engine import Report, Unfit
from cfx.core.parameters import ParameterSpace, squashed
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError, EngineError, PluginError
from cfx.simulation.base import Stepper

_SAME_RELATIVE, _SAME_ABSOLUTE = 1e-5, 1e-8
"""Tolerance for a loss that is computed again: other batches of candidates round differently."""

_STEPS_TOWARDS_DEFAULT = (1.0, 0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01, 0.0)
"""Line search along one parameter, from the search's end point to the model's default: 1 is the
default, 0 the end point. All are evaluated in one batch; the lowest loss plus prior wins."""

_LEAST_FLOOR = 0.05
"""Share of an objective's floor that a smaller loss counts as where ends of a search are compared:
0.01 m/s. Simulated drivers are followed within 1e-6 m/s, of which ends differ by half or by
fifty times, and no optimum is missed."""

_LINE_SEARCHES = 6
"""Most line searches along each parameter (coordinate descent; it ends when none moves)."""


@dataclass(frozen=True)
class Solver:
    """The model, optimizer and objective that all problems of a calibration share.

    Attributes:
        stepper: the model and its time step.
        optimizer: solves the problems.
        seed: the same seed gives the same parameters.
        objective: what is minimised.
        memory: bound for one shard, bytes.
        prior: weight of the prior on driver-specific and pooled parameters
            (`cfx.calibration.losses`); 0: none. Labels have none: ties go to
            driver-specific parameters.
        strength: that of driver-specific parameters, where it is another: a weight, or `chosen`
            (`cfx.calibration.strength`).
        pooled_segment_s: length of the segments that pooled parameters are calibrated on, s; None:
            whole trajectories.
    """

    stepper: Stepper
    optimizer: Optimizer
    seed: int
    objective: Objective = field(default_factory=SpeedRmse)
    memory: int = 1 << 30
    prior: float = 0.0
    strength: float | Literal["chosen"] | None = None
    pooled_segment_s: float | None = None

    @property
    def space(self) -> ParameterSpace:
        """The model's parameter space."""
        return self.stepper.model.space

    @property
    def steps_of_segment(self) -> int | None:
        """Steps of the segments that pooled parameters are calibrated on; None: all.

        Raises:
            ConfigError: they are shorter than a time step.
        """
        if self.pooled_segment_s is None:
            return None
        steps = round(self.pooled_segment_s / self.stepper.dt)
        if steps < 1:
            raise ConfigError(
                f"calibration.pooled_segment_s={self.pooled_segment_s:g}: shorter than the time"
                f" step of {self.stepper.dt:g} s; set at least {self.stepper.dt:g}, or null for"
                " whole trajectories"
            )
        return steps

    def segments(
        self, batch: PairBatch, pair: Tensor, first: Tensor, steps: Tensor
    ) -> SegmentLosses:
        """Returns the losses of segments of pairs; see `SegmentLosses.of_segments`."""
        return SegmentLosses.of_segments(self.stepper, self.objective, batch, pair, first, steps)

    def has_kernel(self, batch: PairBatch) -> bool:
        """Says whether losses come from a compiled kernel where these pairs are."""
        pair = torch.zeros(1, dtype=torch.int64, device=batch.lengths.device)
        return self.segments(batch, pair, pair, pair + 1).accumulates

    @property
    def brief(self) -> Solver:
        """The solver of labels: `Optimizer.brief`."""
        return replace(self, optimizer=self.optimizer.brief())

    @property
    def of_pooled(self) -> Solver:
        """The solver of pooled parameters: `Optimizer.of_pooled`."""
        return replace(self, optimizer=self.optimizer.of_pooled())

    @property
    def scope(self) -> dict[str, Any]:
        """Everything but the trajectories that results depend on, for keys of the cache."""
        model = self.stepper.model
        parameters = [(p.name, p.low, p.high, p.default, p.tuned) for p in self.space]
        return {
            "dt": self.stepper.dt,
            "simulation": self.stepper.identity(),
            "calibration": folder_hash(__file__),
            "model": model.identity(),
            "parameters": parameters,
            "optimizer": self.optimizer.identity(),
            "objective": self.objective.identity(),
            "seed": self.seed,
        }

    def minimize(
        self,
        losses: SegmentLosses | PooledLosses,
        report: Report,
        guesses: Tensor | None = None,
        tolerance: float = 0.0,
    ) -> Arrays:
        """Returns a row per problem; losses in it are without the prior.

        Args:
            losses: of the problems.
            report: called with how many evaluations are done.
            guesses: first guesses `(problems, g, n)` in unit space; None: the model's defaults, and
                the search has the prior.
            tolerance: losses this close are equal.

        Raises:
            PluginError: the optimizer breaks its contract.
        """
        searched = losses
        if guesses is None:
            default = self.space.to_unit(self.space.defaults(device=losses.device))
            guesses = default[None, None, :].expand(losses.problems, 1, -1)
            if self.prior > 0:
                prior = Prior.of(losses, guesses, squashed(default), self.prior)
                searched = replace(losses, prior=prior)
        solution = self.optimizer.minimize(
            searched.for_work(self.optimizer.evaluations(len(self.space))),
            guesses,
            seed=self.seed,
            objective_bytes=searched.bytes_per_candidate,
            memory=self.memory,
            progress=report,
            tolerance=tolerance,
        )
        self._check_losses(searched, solution)
        parameters, loss = self.space.from_unit(solution.best), solution.loss
        if searched.prior is not None:
            best = self.space.to_unit(parameters).double()
            settled = self._settled(searched, best, guesses[0, 0])
            parameters, loss = self.space.from_unit(settled), losses(settled[:, None])[:, 0]
        row = {
            "parameters": parameters.cpu().numpy(),
            "loss": loss.cpu().numpy(),
            "sensitivity": solution.sensitivity.cpu().numpy(),
            "diverged": solution.diverged.cpu().numpy(),
        }
        if self.optimizer.ends(len(self.space)):
            least = max(_LEAST_FLOOR * self.objective.floor, _SAME_ABSOLUTE)
            share_of_least = (solution.loss / least).clamp(max=1.0)
            row["apart"] = (solution.apart * share_of_least).cpu().numpy()
        return row

    def _settled(
        self, losses: SegmentLosses | PooledLosses, best: Tensor, default: Tensor
    ) -> Tensor:
        """Moves the best candidates along each parameter to where loss plus prior is lowest.

        A search stops at what it has tried. Where a parameter hardly matters, the prior alone
        says where it belongs, and its slope is too small for a search among steep ones. So each
        parameter in turn goes towards its default, as far as that is better.
        """
        size = max(1, self.memory // (losses.bytes_per_candidate * len(_STEPS_TOWARDS_DEFAULT)))
        # Whether a kernel pays is asked for as much work as the search was, so that losses have
        # the bits that they had there.
        same_losses = losses.for_work(self.optimizer.evaluations(len(self.space)))
        settled = []
        for first in range(0, len(best), size):
            last = min(first + size, len(best))
            shard = same_losses.take(slice(first, last))
            settled.append(_towards(default, shard, best[first:last]))
        return torch.cat(settled)

    def _check_losses(self, losses: SegmentLosses | PooledLosses, solution: Solution) -> None:
        """Refuses a third party's optimizer that has mixed up its candidates."""
        if registry.is_own(self.optimizer):
            return
        again, returned = losses(solution.best[:, None])[:, 0], solution.loss
        both = again.isfinite() & returned.isfinite()
        same = torch.isclose(again, returned, rtol=_SAME_RELATIVE, atol=_SAME_ABSOLUTE)
        wrong = both & ~same
        if bool(wrong.any()):
            at = int(wrong.nonzero()[0])
            raise PluginError(
                f"{registry.origin(self.optimizer)}: solve returned candidates with losses that are"
                f" not theirs: {float(returned[at]):.6g} where the candidate has"
                f" {float(again[at]):.6g} ({int(wrong.sum())} of {len(returned)} problems)"
            )


@dataclass(frozen=True)
class CalibrationShard:
    """Base of the shards of a calibration.

    Attributes:
        solver: what all problems have in common.
        code: hash of `solver.scope` where the shard was cut.
        compiled: losses came from a compiled kernel there: its last bits are its own.
        batch: the trajectories, `(P, T)`.
    """

    solver: Solver
    code: str
    compiled: bool
    batch: PairBatch

    def solve(self, report: Report) -> list[Arrays]:
        """Returns a cache entry for each request.

        Raises:
            EngineError: here is other code than where the shard was cut.
            Unfit: no kernel can be compiled here, as there: the compiler is missing, or the disk
                full.
        """
        if content_key(self.solver.scope) != self.code:
            raise EngineError(
                "a worker has other code than this job (another version of cfx or of a plugin);"
                " install the same on all workers, and start them again"
            )
        if self.compiled and not self.solver.has_kernel(self.batch):
            raise Unfit(
                "no kernel can be compiled there (no C++ compiler, or no place on the disk), so"
                " that results would differ in their last bits"
            )
        losses, guesses, tolerance = self.problem()
        return self.entries(self.solver.minimize(losses, report, guesses, tolerance))

    def problem(self) -> tuple[SegmentLosses | PooledLosses, Tensor | None, float]:
        """Returns what is minimised, with the guesses and the tolerance of `Solver.minimize`."""
        raise NotImplementedError

    def entries(self, solution: Arrays) -> list[Arrays]:
        """Returns the entries of the cache that a solution is kept in: one for each problem."""
        entries = []
        for number in range(len(solution["loss"])):
            entries.append({name: values[number] for name, values in solution.items()})
        return entries


@dataclass(frozen=True)
class SegmentShard(CalibrationShard):
    """Constant parameters of each segment: of whole trajectories, or of windows.

    Attributes:
        pair, first, steps: `(W,)`, the pair of each segment, the frame that it starts from, and how
            many steps it lasts.
        counts: segments of each entry of the cache; None: one.
        guesses: `(P, g, n)` in unit space, first guesses in each segment of a pair; None: the
            model's defaults.
        tolerance: losses this close are equal, in the objective's unit.
    """

    pair: Tensor
    first: Tensor
    steps: Tensor
    counts: tuple[int, ...] | None = None
    guesses: Tensor | None = None
    tolerance: float = 0.0

    def problem(self) -> tuple[SegmentLosses | PooledLosses, Tensor | None, float]:
        losses = self.solver.segments(self.batch, self.pair, self.first, self.steps)
        guesses = self.guesses
        if guesses is not None:
            guesses = guesses[self.pair]
        return losses, guesses, self.tolerance

    def entries(self, solution: Arrays) -> list[Arrays]:
        if self.counts is None:
            return super().entries(solution)
        entries, first = [], 0
        for count in self.counts:
            segments = slice(first, first + count)
            entries.append({name: values[segments] for name, values in solution.items()})
            first += count
        return entries


@dataclass(frozen=True)
class PooledShard(CalibrationShard):
    """Constant parameters of groups of pairs.

    Attributes:
        last: `(P,)`, the last frame that may be used of each.
        members: `(K, P)` bool, the pairs of each group.
    """

    last: Tensor
    members: Tensor

    def problem(self) -> tuple[SegmentLosses | PooledLosses, Tensor | None, float]:
        stepper, objective = self.solver.stepper, self.solver.objective
        length = self.solver.steps_of_segment
        segments = TrajectorySegments.of_pairs(stepper, objective, self.batch, self.last, length)
        members = self.members[:, segments.pair]
        losses = PooledLosses(segments, members, self.solver.memory, segments.weight)
        return losses, None, 0.0


def _towards(default: Tensor, losses: SegmentLosses | PooledLosses, best: Tensor) -> Tensor:
    """Returns `(P, n)` in unit space: see `Solver._settled`."""
    steps = torch.tensor(_STEPS_TOWARDS_DEFAULT, dtype=best.dtype, device=best.device)
    default, problem = default.to(best), torch.arange(len(best), device=best.device)
    point = best
    for _ in range(_LINE_SEARCHES):
        before = point
        for column in range(best.shape[1]):
            # (P, n) -> (P, steps, n): the same point, but for one parameter.
            candidates = point[:, None].repeat(1, len(steps), 1)
            candidates[..., column] += steps * (default[column] - point[:, column, None])
            index = losses(candidates).nan_to_num(nan=torch.inf).argmin(dim=1)
            point = candidates[problem, index]
        if torch.equal(point, before):
            break
    return point
