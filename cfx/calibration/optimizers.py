"""The contract of an optimizer: many independent bounded problems in one call.

Shapes: P problems, q candidates for each in one call, n parameters, g guesses, e evaluations of
each problem in all. Everything here is float64: Gaussian processes need it, and losses of
neighbouring candidates differ by little.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.memory import require_memory
from cfx.core.threads import cores, share
from cfx.errors import ConfigError, PluginError

Progress = Callable[[int], None]
"""Called with how many more evaluations are done; they sum to problems times evaluations."""

Tried = Tensor | tuple[Tensor, ...]
"""Candidates `(P, e, n)`, whole or in blocks along e."""

TIE_RELATIVE, TIE_ABSOLUTE = 1e-6, 1e-9
"""Losses within `TIE_ABSOLUTE + TIE_RELATIVE * best` of the best count as equal: above rounding,
below anything that matters."""


AT_ONCE = 4096
"""Candidates of one problem in one call of the losses: intermediate values stay small however many
an optimizer asks for."""

_LOSSES_AT_ONCE = 1 << 19
"""Losses of one shard on a CPU, at most: 4 MB, which are written and read again in its cache."""


_SEARCHED_AT_ONCE = 32
"""Problems of one shard on a CPU, at most, where `solve` returns a part of its evaluations: threads
share shards. The same on any machine, since eager losses round by the size of a batch."""


class CandidateLosses(Protocol):
    """The losses of candidates in P independent problems, which an optimizer minimises.

    In a calibration these are values of the job's objective (`cfx.plugin.Objective`), in its unit.
    """

    @property
    def problems(self) -> int:
        """P."""
        ...

    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(P, q)`; NaN or infinity where a candidate diverges.

        Args:
            candidates: `(P, q, n)` in unit space.
        """
        ...

    def take(self, problems: slice | Tensor) -> CandidateLosses:
        """Returns the losses of some problems alone: a slice of them, or their numbers `(S,)`."""
        ...

    def rough(self) -> CandidateLosses:
        """Returns the same losses to about five digits in less time, or the same where none is.

        For a search; what it ends with is evaluated again.
        """
        ...


@dataclass(frozen=True)
class Solution:
    """The best candidates of each problem, and their losses.

    Attributes:
        best: `(P, n)` in unit space: of the candidates whose loss ties with the lowest, the nearest
            to the problem's first guess; the first guess itself if every candidate diverged.
        loss: `(P,)`, the loss of `best`; infinity if every candidate diverged.
        filling: `(P, 3)`, lowest, median and highest finite loss of the space-filling candidates
            (`Optimizer.space_filling`): neither guesses nor what an optimizer chose by looking at
            losses. The median of an even number is the lower of the middle two. NaN if none is
            finite.
        diverged: `(P,)` int64, number of candidates that `solve` returned whose loss was NaN or
            infinite.
        apart: `(P,)`, by how much the second lowest of the ends of independent searches
            (`Optimizer.ends`) is above the lowest, as a share of it; NaN where there are none.
    """

    best: Tensor
    loss: Tensor
    filling: Tensor
    diverged: Tensor
    apart: Tensor

    @classmethod
    def joined(cls, shards: Sequence[Solution]) -> Solution:
        """Returns the solution of all problems, of those of their shards in order."""
        return cls(
            torch.cat([shard.best for shard in shards]),
            torch.cat([shard.loss for shard in shards]),
            torch.cat([shard.filling for shard in shards]),
            torch.cat([shard.diverged for shard in shards]),
            torch.cat([shard.apart for shard in shards]),
        )

    @property
    def sensitivity(self) -> Tensor:
        """Sensitivity of the loss to the parameters, `(P,)`, in the unit of the loss.

        The median loss of the space-filling candidates minus `loss`; never negative. It is 0 where
        nothing tells candidates apart or every candidate diverged.
        """
        difference = self.filling[:, 1] - self.loss
        return difference.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).clamp(min=0.0)


class Optimizer(Component):
    """Base of every optimizer.

    Life cycle: calibration calls `minimize` once per set of problems. `minimize` cuts the set
    into shards that respect the memory bound, calls `solve` for each, checks what comes back and
    reduces it to a `Solution`. A subclass implements `solve`, `evaluations` and
    `bytes_per_problem`. It keeps no state between calls. The result of a problem must not depend on
    which other problems stand beside it, beyond rounding.
    `cfx_contracts.optimizers` tests all this.
    """

    kind = "optimizer"
    in_threads: ClassVar[bool] = False
    """`solve` may be called for several shards at once, in threads of one process: how problems are
    cut into shards changes no bit, and a cluster cuts them further."""
    in_shards: ClassVar[bool] = False
    """Whole trajectories that are calibrated together are cut into the same shards on every engine,
    so that the workers of a cluster share them: for an optimizer whose last bits depend on how
    problems are cut. One with neither solves all together."""

    @abstractmethod
    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tried, Tensor]:
        """Evaluates candidates of all problems of one shard.

        Args:
            objective: returns the losses of candidates within [0, 1]: finite or infinity, never
                NaN. It counts evaluations.
            guesses: `(P, g, n)` in unit space, g >= 1: candidates to evaluate first; they count as
                evaluations.
            seed: the same for every shard; 0 is a seed like any other.

        Returns:
            Candidates `(P, e, n)` and their losses `(P, e)`, `returned(n)` of each problem: the
            first `space_filling(n)` and last `ends(n)` stand where these say. Candidates may be
            expanded views, and may come in blocks along e, a tuple of `(P, q, n)`: those that all
            problems share then need no copy for each.
        """

    @abstractmethod
    def evaluations(self, n: int) -> int:
        """Returns the most evaluations of each problem.

        Args:
            n: number of parameters.
        """

    @abstractmethod
    def bytes_per_problem(self, n: int) -> int:
        """Returns an upper estimate of the memory that `solve` needs for one problem.

        Its result and the losses do not count.

        Args:
            n: number of parameters.
        """

    def returned(self, n: int) -> int:
        """Returns e, how many evaluations of each problem `solve` returns; all by default."""
        return self.evaluations(n)

    def evaluations_at_once(self, n: int) -> int:
        """Returns the most candidates of one problem in one call of the losses; 1 by default."""
        return 1

    def space_filling(self, n: int) -> int:
        """Returns how many first evaluations are chosen without looking at losses.

        Guesses are included. All that are returned unless overridden.
        """
        return self.returned(n)

    def ends(self, n: int) -> int:
        """Returns how many of the last candidates are ends of independent global searches.

        Where they differ, the optimum may have been missed. 0 by default: it is not known.
        """
        return 0

    def brief(self) -> Optimizer:
        """Returns the optimizer of labels; itself by default.

        There are hundreds of windows for each driver.
        """
        return self

    def with_effort(self, times: float, n: int) -> Optimizer:
        """Returns the optimizer for parameters that are harder to find; itself by default.

        Args:
            times: how many times the usual evaluations they take (`DrivingModel.search_effort`).
            n: number of parameters.
        """
        return self

    def of_pooled(self) -> Optimizer:
        """Returns the optimizer of pooled parameters; that of labels by default.

        One of their evaluations simulates all drivers.
        """
        return self.brief()

    def minimize(
        self,
        objective: CandidateLosses,
        guesses: Tensor,
        *,
        seed: int,
        objective_bytes: int = 0,
        memory: int = 1 << 30,
        progress: Progress = lambda _: None,
        tolerance: float = 0.0,
    ) -> Solution:
        """Solves all problems.

        Args:
            objective: losses of the problems.
            guesses: `(P, g, n)` in unit space, g >= 1.
            seed: the same seed gives the same result.
            objective_bytes: memory that the loss of one candidate of one problem needs.
            memory: bound in bytes for one shard; a shard holds at least one problem.
            progress: called with the number of evaluations done since the last call; where a search
                ended early, with those left out too.
            tolerance: losses this close to the lowest, in their unit, count as equal besides those
                that rounding makes equal.

        Raises:
            PluginError: the optimizer asks for a candidate outside [0, 1], of another shape or not
                in float64; or it returns NaN, anything of another shape or dtype, or another number
                of evaluations than it says.
        """
        problems, _, n = guesses.shape
        evaluations, candidates = self.evaluations(n), self.returned(n)
        returned = 8 * candidates * (2 * n + 4)
        each = self.bytes_per_problem(n) + returned + objective_bytes * self.evaluations_at_once(n)
        require_memory(each, f"an optimizer with {evaluations:,} evaluations of each problem")
        shards_at_once = 1
        if self.in_threads:
            shards_at_once = cores()
        size = max(1, min(problems, memory // (each * shards_at_once)))
        if guesses.device.type == "cpu":
            size = min(size, max(1, _LOSSES_AT_ONCE // candidates))
            if candidates < evaluations:
                size = min(size, _SEARCHED_AT_ONCE)
        guesses = guesses.double().clamp(0.0, 1.0)
        ended = Event()

        def solved(first: int) -> Solution:
            last = min(first + size, problems)
            guesses_of_shard, origin = guesses[first:last], registry.origin(self)
            done: list[int] = []

            def count(number: int) -> None:
                done.append(number)
                progress(number)

            of_shard = objective.take(slice(first, last))
            checked = _CheckedLosses(of_shard, count, n, origin, ended)
            tried, losses = self.solve(checked, guesses_of_shard, seed=seed)
            blocks = tried if isinstance(tried, tuple) else (tried,)
            self._check(blocks, losses, guesses_of_shard)
            left = len(guesses_of_shard) * evaluations - sum(done)
            if left > 0:  # a search may end early
                progress(left)
            filling, ends = self.space_filling(n), self.ends(n)
            return _reduce(blocks, losses, guesses_of_shard, filling, ends, tolerance)

        starts = range(0, problems, size)
        try:
            if self.in_threads and guesses.device.type == "cpu" and len(starts) > 1:
                shards = share(solved, starts, level="shards")
            else:
                shards = [solved(first) for first in starts]
        finally:
            ended.set()  # one thread failed, or a signal came: stop the others
        return Solution.joined(shards)

    def _check(self, blocks: tuple[Tensor, ...], losses: Tensor, guesses: Tensor) -> None:
        problems, _, n = guesses.shape
        expected = (problems, self.returned(n))
        evaluations, shapes, dtypes = 0, set(), {losses.dtype}
        for block in blocks:
            evaluations += block.shape[1]
            dtypes.add(block.dtype)
        for block in blocks:
            shapes.add((block.shape[0], evaluations, *block.shape[2:]))
        if losses.shape != expected or shapes != {(*expected, n)}:
            returned = ", ".join(str(tuple(block.shape)) for block in blocks)
            raise PluginError(
                f"{registry.origin(self)}: solve must return candidates {(*expected, n)} and losses"
                f" {expected} as returned() says, but returned {returned} and"
                f" {tuple(losses.shape)}"
            )
        if dtypes != {torch.float64}:
            raise PluginError(
                f"{registry.origin(self)}: solve must return float64, but returned candidates in"
                f" {blocks[0].dtype} and losses in {losses.dtype}"
            )
        if bool(losses.isnan().any()) or not all(map(_in_unit_space, blocks)):
            raise PluginError(
                f"{registry.origin(self)}: solve must return candidates within [0, 1] and losses"
                " that are numbers or infinity, but returned NaN or a candidate outside"
            )


def _reduce(
    blocks: tuple[Tensor, ...],
    losses: Tensor,
    guesses: Tensor,
    space_filling: int,
    ends: int,
    tolerance: float,
) -> Solution:
    """Reduces the evaluations of a shard to its solution.

    Args:
        blocks: candidates, as an optimizer returned them.
        losses: of all of them, `(P, e)`.
        guesses: `(P, g, n)`.
        space_filling: how many first evaluations were chosen without looking at losses.
        ends: how many of the last are ends of independent searches.
        tolerance: losses this close to the lowest are equal.
    """
    g = guesses.shape[1]
    finite = losses.isfinite()
    lowest = losses.amin(dim=1, keepdim=True)
    ties = finite & (losses <= lowest + tolerance + TIE_ABSOLUTE + TIE_RELATIVE * lowest.abs())
    distances = [_squared_distance(block, guesses[:, 0]) for block in blocks]
    distance = torch.cat(distances, dim=1)
    # Among candidates that tie, the nearest to the first guess: what the recording does not tell
    # apart stays where it was expected.
    index = distance.where(ties, torch.inf).argmin(dim=1)
    best = _at(blocks, index)
    any_finite = finite.any(dim=1)
    best = best.where(any_finite[:, None], guesses[:, 0])
    loss = losses.gather(1, index[:, None]).squeeze(1).where(any_finite, torch.inf)
    first = g
    if space_filling <= g:
        first = 0  # all space-filling evaluations are guesses, so guesses count
    filling = _low_median_high(losses[:, first:space_filling], finite[:, first:space_filling])
    apart = _apart(losses[:, losses.shape[1] - ends :])
    return Solution(best, loss, filling, (~finite).sum(dim=1), apart)


def _apart(ends: Tensor) -> Tensor:
    """Returns how far the second lowest of ends `(P, k)` is above the lowest, as a share of it.

    NaN with fewer than two ends, or where one of the two is no number.
    """
    if ends.shape[1] < 2:
        return ends.new_full((len(ends),), torch.nan)
    lowest, second = ends.sort(dim=1).values[:, :2].unbind(1)
    share = (second - lowest) / lowest.abs().clamp(min=TIE_ABSOLUTE)
    return share.where(second.isfinite(), torch.nan)


def _low_median_high(losses: Tensor, finite: Tensor) -> Tensor:
    """Returns the lowest, median and highest finite loss of each row, `(P, 3)`; NaN if none is."""
    if bool(finite.all()) and losses.device.type == "cpu" and losses.shape[1]:
        # NumPy sorts with vector instructions, in less time than PyTorch finds the median.
        ordered = np.sort(losses.detach().numpy(), axis=1)
        return torch.as_tensor(ordered[:, [0, (losses.shape[1] - 1) // 2, -1]])
    usable = finite.any(dim=1)
    low = losses.where(finite, torch.inf).amin(dim=1)
    high = losses.where(finite, -torch.inf).amax(dim=1)
    median = losses.where(finite, torch.nan).nanmedian(dim=1).values
    return torch.stack([low, median, high], dim=1).where(usable[:, None], torch.nan)


def _squared_distance(block: Tensor, guess: Tensor) -> Tensor:
    """Returns squared distances `(P, q)` of candidates `(P, q, n)` to guesses `(P, n)`."""
    total = guess.new_zeros(block.shape[:2])
    for value, origin in zip(block.unbind(-1), guess.unbind(-1), strict=True):
        total += (value - origin[:, None]).square_()
    return total


def _at(blocks: tuple[Tensor, ...], index: Tensor) -> Tensor:
    """Returns the candidates `(P, n)` of numbers `(P,)`, counted through all blocks."""
    best = blocks[0].new_empty((len(index), blocks[0].shape[2]))
    first = 0
    for block in blocks:
        rows = ((index >= first) & (index < first + block.shape[1])).nonzero()[:, 0]
        best[rows] = block[rows, index[rows] - first]
        first += block.shape[1]
    return best


def _in_unit_space(candidates: Tensor) -> bool:
    """Says whether all candidates lie within [0, 1]. Written so that NaN fails too."""
    if candidates.stride(0) == 0:
        candidates = candidates[:1]
    return bool(((candidates >= 0) & (candidates <= 1)).all())


@dataclass(frozen=True)
class _CheckedLosses:
    """Evaluates candidates in blocks of `AT_ONCE`, and replaces NaN by infinity.

    Counts evaluations. Refuses candidates outside the bounds, and all after the minimization ended.
    """

    objective: CandidateLosses
    progress: Progress
    n: int
    optimizer: str
    ended: Event

    @property
    def problems(self) -> int:
        return self.objective.problems

    def __call__(self, candidates: Tensor) -> Tensor:
        if self.ended.is_set():
            raise RuntimeError("this minimization has ended")
        shape = tuple(candidates.shape)
        if (
            candidates.dtype != torch.float64
            or len(shape) != 3
            or (shape[0], shape[2]) != (self.problems, self.n)
        ):
            raise PluginError(
                f"{self.optimizer}: it asked for candidates {shape} in {candidates.dtype}; it must"
                f" ask for ({self.problems}, q, {self.n}) in float64"
            )
        if not _in_unit_space(candidates):
            raise PluginError(
                f"{self.optimizer}: it asked for a candidate outside the bounds [0, 1] of unit"
                " space"
            )
        of_blocks = [candidates.new_empty((self.problems, 0))]
        for block in torch.split(candidates, AT_ONCE, dim=1):
            if block.shape[1] == 0:
                continue
            losses = self.objective(block).to(torch.float64)
            self.progress(losses.numel())
            if not bool(losses.sum().isfinite()):
                losses = losses.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=torch.inf)
            of_blocks.append(losses)
        return torch.cat(of_blocks, dim=1)

    def take(self, problems: slice | Tensor) -> CandidateLosses:
        return replace(self, objective=self.objective.take(problems))

    def rough(self) -> CandidateLosses:
        return replace(self, objective=self.objective.rough())


def check_room(evaluations: int, guesses: int, *, key: str) -> None:
    """Checks that the setting `key` allows as many evaluations as there are first guesses.

    Raises:
        ConfigError: it does not.
    """
    if evaluations < guesses:
        raise ConfigError(
            f"optimizer.{key}={evaluations}: there are {guesses} first guesses;"
            f" set optimizer.{key} >= {guesses}"
        )


def sobol(count: int, n: int, *, seed: int, device: torch.device) -> Tensor:
    """Returns scrambled Sobol points `(count, n)` within [0, 1], float64."""
    if count == 0:
        return torch.empty((0, n), dtype=torch.float64, device=device)
    # torch leaves the engine untyped.
    make: Any = torch.quasirandom.SobolEngine
    engine = make(n, scramble=True, seed=seed)
    points: Tensor = engine.draw(count, dtype=torch.float64)
    return points.to(device)
