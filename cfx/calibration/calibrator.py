"""The calibrator: constant parameters of each driver, pooled ones, and those of each window.

All three are the same to an optimizer: independent problems, each the loss of segments simulated
from a measured state. Every result is cached on its own, so an interrupted calibration goes on
where it stopped.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.cache import Arrays, Cache, first_fit
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import Optimizer
from cfx.calibration.settings import APART
from cfx.calibration.shards import CalibrationShard, PooledShard, SegmentShard, Solver
from cfx.calibration.strength import FITTED, MOST, WEIGHTS, PriorStrength
from cfx.core import memory
from cfx.core.component import content_key
from cfx.core.engine import Engine
from cfx.core.local_engine import LocalEngine
from cfx.core.parameters import ParameterSpace
from cfx.core.progress import Task
from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.simulation.windows import Windows, WindowSettings

log = logging.getLogger(__name__)

_CLAIM = 1024
"""Problems that are claimed and solved together: enough to fill the batch, few enough that an
interruption loses little."""

_TRAJECTORIES_OF_SHARD = 64
"""Whole trajectories that are solved in one shard of a cluster: each is the work of a hundred
windows."""

_FRAMES_AT_ONCE = 200_000
"""Frames of trajectories that are simulated at once to report their losses: some 30 MB."""

_NAMED = 3
"""Pairs that a warning names."""

_WINDOWS_OF_ENTRY = 32
"""Windows of an entry of the cache: the first windows of a pair have the same labels, however many
of them a job asks for."""


@dataclass(frozen=True)
class WindowLabels:
    """The best parameters of each window.

    Attributes:
        windows: which windows.
        parameters: `(W, n)`, SI units: of those with a loss within the tie tolerance of the lowest,
            the nearest to the driver-specific parameters; so where nothing tells candidates apart
            they are the driver-specific parameters.
        loss: `(W,)`, the objective's loss with these parameters, in its unit.
        sensitivity: `(W,)`, how much the choice of parameters matters in the window: median loss of
            the space-filling candidates minus `loss`. 0 where all candidates have the same loss:
            such a label is arbitrary.
        diverged: `(W,)` int64, candidates whose loss was not a number.
    """

    windows: Windows
    parameters: Tensor
    loss: Tensor
    sensitivity: Tensor
    diverged: Tensor

    def select(self, pairs: Tensor) -> WindowLabels:
        """Returns the labels of some pairs, `(D,)` int64, which are numbered anew.

        A pair may stand there more than once.
        """
        windows, places = self.windows.select(pairs.cpu())
        places = places.to(self.loss.device)
        return WindowLabels(
            windows,
            self.parameters[places],
            self.loss[places],
            self.sensitivity[places],
            self.diverged[places],
        )

    def metrics(self) -> dict[str, float]:
        """Returns the means over windows `labels/loss` and `labels/sensitivity`, in its unit."""
        return {
            "labels/loss": float(self.loss.mean()),
            "labels/sensitivity": float(self.sensitivity.mean()),
        }

    def to_frame(self, pairs: PairSet, names: Sequence[str]) -> pd.DataFrame:
        """Returns a row per window.

        Columns: pair_id, window, time_s (its start), `parameter_NAME`, loss and sensitivity (in the
        objective's unit), diverged.
        """
        windows = self.windows
        pair_ids = [pairs[number].pair_id for number in windows.pair.tolist()]
        columns: dict[str, Any] = {
            "pair_id": pair_ids,
            "window": windows.number.numpy(),
            "time_s": windows.first.numpy() * pairs.dt,
        }
        for column, name in enumerate(names):
            columns[f"parameter_{name}"] = self.parameters[:, column].cpu().numpy()
        columns["loss"] = self.loss.cpu().numpy()
        columns["sensitivity"] = self.sensitivity.cpu().numpy()
        columns["diverged"] = self.diverged.cpu().numpy()
        return pd.DataFrame(columns)


_LEAST_LOSS = 1e-3
"""Share of an objective's floor (at least this, in its unit) that a smaller loss counts as: drivers
who stand are followed without any error, which has no logarithm."""


def _silent(description: str, _total: int) -> Task:
    """Makes a progress display that shows nothing."""
    return Task(description, 0)


class Calibrator:
    """Calibrates one model with one optimizer.

    Args:
        solver: model, optimizer, objective and prior.
        cache: where results are kept.
        progress: makes a progress display, given a description and a total.
        reported: objectives by name whose losses `losses` reports beside the minimised one.
        strengths: of the prior, as they were chosen.
        engine: solves the problems, shard by shard; this machine's cores unless given.
    """

    def __init__(
        self,
        solver: Solver,
        *,
        cache: Cache,
        progress: Callable[[str, int], Task] = Task,
        reported: Mapping[str, Objective] | None = None,
        engine: Engine | None = None,
    ) -> None:
        self.solver = solver
        self.cache = cache
        self.progress = progress
        self.reported = reported or {}
        self.engine = engine or LocalEngine()
        self.strengths: list[PriorStrength] = []
        self._apart: dict[tuple[str, int], float] = {}

    @property
    def space(self) -> ParameterSpace:
        """The model's parameter space."""
        return self.solver.space

    def tie_tolerance(self, settings: WindowSettings) -> float:
        """Returns which losses of a window count as equal, in the objective's unit."""
        if settings.tie_tolerance is None:
            return self.solver.objective.tie_tolerance
        return settings.tie_tolerance

    def driver_specific(self, pairs: PairSet, batch: PairBatch, last: Tensor) -> Tensor:
        """Finds one parameter set per pair: the driver-specific parameters.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            last: `(P,)`, the last frame that may be used; the pair is simulated from frame 0 to it
                in one closed loop.

        Returns:
            `(P, n)`, SI units.
        """
        fitted, weight = self, self.solver.strength
        if weight == "chosen":
            weight = self.prior_strength(pairs, batch, last).weight
        if weight is not None:
            fitted = self._with_prior(weight, self.progress)
        parameters, apart = fitted.searched(pairs, batch, last)
        missed = []
        for pair, end, share in zip(pairs, last.tolist(), apart, strict=True):
            self._apart[pair.fingerprint, end] = share
            if share > APART:
                missed.append(pair.pair_id)
        if missed:
            named = ", ".join(missed[:_NAMED]) + (" ..." if len(missed) > _NAMED else "")
            log.warning(
                "The optimum of %d of %d pairs may have been missed (%s): independent ends of the"
                " search differ by more than %.0f %% of the loss (ends_apart in fits.parquet);"
                " there may be several ways to drive like them",
                len(missed),
                len(pairs),
                named,
                100 * APART,
            )
        return parameters

    def searched(
        self, pairs: PairSet, batch: PairBatch, last: Tensor, first: Tensor | None = None
    ) -> tuple[Tensor, list[float]]:
        """Returns each pair's parameters with the solver's prior, and how far its ends were apart.

        Args:
            pairs, batch, last: as in `driver_specific`.
            first: `(P,)`, the frame that each is simulated from; None: frame 0.
        """
        requested_device, batch = batch.lengths.device, self._where_it_is_fast(batch)
        device = batch.lengths.device
        last = last.to(device)
        start = torch.zeros_like(last)
        if first is not None:
            start = first.to(device)
        keys = []
        for pair, begin, end in zip(pairs, start.tolist(), last.tolist(), strict=True):
            frames = [begin, end]
            keys.append(
                self._key("driver_specific", pair.fingerprint, frames=frames, **self._prior_key)
            )
        compiled = self._has_kernel(batch)

        def shard(chosen: Tensor, claim: Tensor) -> SegmentShard:
            chosen = chosen.to(device)
            steps = last - start
            solver = self._solver_for(len(claim) * int(steps[claim].max()))
            return SegmentShard(
                solver,
                self._code,
                compiled,
                batch[chosen].trimmed(),
                pair=torch.arange(len(chosen), device=device),
                first=start[chosen],
                steps=steps[chosen],
            )

        title = "Driver-specific parameters"
        sizes = [1] * len(pairs)
        results = self._cached(title, keys, sizes, shard, at_most=_TRAJECTORIES_OF_SHARD)
        apart = [float(entry.get("apart", math.nan)) for entry in results]
        return _stacked(results, requested_device), apart

    def prior_strength(self, pairs: PairSet, batch: PairBatch, last: Tensor) -> PriorStrength:
        """Tries how strong a prior serves driver-specific parameters best.

        They are calibrated on the first two thirds of what may be used and drive the last one, then
        on the last two and drive the first, each from a measured state; nothing after `last` is
        read.

        Args:
            pairs, batch, last: as in `driver_specific`.
        """
        step = max(1, -(-len(pairs) // MOST))
        chosen = torch.arange(0, len(pairs), step)
        which = torch.zeros(len(pairs), dtype=torch.bool)
        which[chosen] = True
        some = pairs.select(which.tolist(), "not tried")
        tried, end = batch[chosen.to(batch.lengths.device)], last.cpu()[chosen]
        later = (FITTED * end).long().clamp(min=1)
        earlier = end - later
        by_weight = []
        for weight in WEIGHTS:
            calibrator = self._with_prior(weight, _silent)
            of_first, _ = calibrator.searched(some, tried, later)
            of_last, _ = calibrator.searched(some, tried, end, earlier)
            begin = torch.zeros_like(end)
            held_out = [
                self._held_out_losses(tried, later, end, of_first),
                self._held_out_losses(tried, begin, earlier, of_last),
            ]
            by_weight.append(torch.stack(held_out))
        losses = torch.stack(by_weight)
        # (weights, thirds, drivers): the same drivers count for each weight.
        is_known = losses.isfinite().all(0).all(0)
        least = max(_LEAST_LOSS * self.solver.objective.floor, _LEAST_LOSS)
        means = losses[:, :, is_known].clamp(min=least).log().mean((1, 2)).exp()
        strength = PriorStrength(
            dict(zip(WEIGHTS, means.tolist(), strict=True)), int(is_known.sum())
        )
        self.strengths.append(strength)
        log.info(strength.worded(self.solver.objective.unit))
        return strength

    @torch.no_grad()
    def _held_out_losses(
        self, batch: PairBatch, first: Tensor, last: Tensor, parameters: Tensor
    ) -> Tensor:
        """Returns the loss of each pair's parameters from a measured state on, `(P,)`."""
        device = batch.lengths.device
        pair = torch.arange(len(batch), device=device)
        steps = (last - first).to(device)
        losses = self.solver.segments(batch, pair, first.to(device), steps)
        unit = self.space.to_unit(parameters.to(device))[:, None]
        return losses(unit)[:, 0].double()

    def _with_prior(self, weight: float, progress: Callable[[str, int], Task]) -> Calibrator:
        """Returns the same calibrator with another weight of the prior."""
        solver = replace(self.solver, prior=weight, strength=None)
        return Calibrator(
            solver,
            cache=self.cache,
            progress=progress,
            reported=self.reported,
            engine=self.engine,
        )

    def apart(self, pairs: Iterable[Pair], last: Tensor) -> list[float]:
        """Returns how far the ends of the search of each pair's parameters were apart.

        See `Solution.apart`. NaN where the optimizer has no such ends, or `driver_specific` was not
        asked.

        Args:
            pairs: P pairs.
            last: `(P,)`, as in `driver_specific`.
        """
        ends = zip(pairs, last.tolist(), strict=True)
        return [self._apart.get((pair.fingerprint, end), math.nan) for pair, end in ends]

    def pooled(self, pairs: PairSet, batch: PairBatch, last: Tensor, members: Tensor) -> Tensor:
        """Finds one parameter set for each of K groups of pairs: the pooled parameters.

        Their loss is the mean of their pairs' losses (`PooledLosses`), of whole trajectories or of
        segments (`Solver.pooled_segment_s`).

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            last: `(P,)`, the last frame that may be used of each.
            members: `(K, P)` bool, the pairs of each group; a pair may be in several.

        Returns:
            `(K, n)`, SI units.

        Raises:
            ConfigError: segments are shorter than a time step.
        """
        requested_device, batch = batch.lengths.device, self._where_it_is_fast(batch)
        device = batch.lengths.device
        members, last = members.cpu(), last.to(device)
        details: dict[str, Any] = dict(self._prior_key)
        if self.solver.steps_of_segment is not None:
            details["segment"] = self.solver.steps_of_segment
        keys = []
        for row in members:
            group = _group_key(pairs, last, row)
            keys.append(self._key("pooled", "", pairs=group, **details))

        compiled, solver = self._has_kernel(batch), self.solver.of_pooled
        code = content_key(solver.scope)

        def shard(chosen: Tensor, _claim: Tensor) -> PooledShard:
            groups = members[chosen].to(device)
            used = groups.any(0).nonzero()[:, 0]
            trajectories = batch[used].trimmed()
            return PooledShard(solver, code, compiled, trajectories, last[used], groups[:, used])

        # One shard: groups have candidates in common, and what is simulated for one serves all.
        results = self._cached("Pooled parameters", keys, [1] * len(members), shard, solver=solver)
        return _stacked(results, requested_device)

    def labels(
        self, pairs: PairSet, batch: PairBatch, windows: Windows, fixed: Tensor
    ) -> WindowLabels:
        """Finds the parameters of each window; ties go to the driver-specific parameters.

        Not to the pooled ones: labels would depend on the fold and be calibrated once for each.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            windows: W windows of these pairs.
            fixed: `(P, n)`, SI units: the first guess in each window, before the model's defaults.
        """
        requested_device, batch = batch.lengths.device, self._where_it_is_fast(batch)
        device = batch.lengths.device
        fixed = fixed.to(device)
        counts = torch.bincount(windows.pair, minlength=len(pairs))
        tolerance = self.tie_tolerance(windows.settings)
        description = {**windows.settings.model_dump(), "tie_tolerance": tolerance}
        keys, owner, begin, sizes = [], [], [], []
        rows = zip(pairs, counts.tolist(), fixed.tolist(), strict=True)
        for number, (pair, count, row) in enumerate(rows):
            for first in range(0, count, _WINDOWS_OF_ENTRY):
                size = min(_WINDOWS_OF_ENTRY, count - first)
                which = {"first": first, "windows": size, "driver_specific": row}
                keys.append(self._key("labels", pair.fingerprint, **which, **description))
                owner.append(number)
                begin.append(first)
                sizes.append(size)
        defaults = self.space.defaults(device=device).expand_as(fixed)
        guesses = self.space.to_unit(torch.stack([fixed, defaults], dim=1))
        pair_of_entry = torch.tensor(owner)
        first_of_entry, size_of_entry = torch.tensor(begin), torch.tensor(sizes)

        compiled, brief = self._has_kernel(batch), self.solver.brief
        code = content_key(brief.scope)

        def shard(chosen: Tensor, _claim: Tensor) -> SegmentShard:
            count = size_of_entry[chosen]
            # The entry of each window, and the window's number in it.
            entry = torch.arange(len(chosen)).repeat_interleave(count)
            number = torch.arange(len(entry)) - (count.cumsum(0) - count)[entry]
            used, place = torch.unique(pair_of_entry[chosen], return_inverse=True)
            used = used.to(device)
            window = first_of_entry[chosen][entry] + number
            start = (window * windows.settings.stride).to(device)
            return SegmentShard(
                brief,
                code,
                compiled,
                batch[used].trimmed(),
                pair=place[entry].to(device),
                first=start,
                steps=torch.full_like(start, windows.settings.length),
                counts=tuple(count.tolist()),
                guesses=guesses[used],
                tolerance=tolerance,
            )

        title = "Per-window calibrated parameters (labels)"
        results = self._cached(title, keys, sizes, shard, solver=brief, **description)
        joined = {}
        for name in results[0]:
            values = np.concatenate([entry[name] for entry in results])
            joined[name] = torch.as_tensor(values).to(requested_device)
        return WindowLabels(windows=windows, **joined)

    @torch.no_grad()
    def losses(
        self,
        batch: PairBatch,
        last: Tensor,
        parameters: Tensor,
        members: Tensor | None = None,
    ) -> dict[str, float]:
        """Returns the mean loss of constant parameters over pairs, by each objective of `reported`.

        Args:
            batch: P pairs.
            last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed
                loop.
            parameters: `(P, n)`, one set per pair; with `members` `(K, n)`, one per group. SI
                units.
            members: `(K, P)` bool, the pairs of each group.
        """
        device = batch.lengths.device
        pair = torch.arange(len(batch), device=device)
        row = pair
        if members is not None:
            row, pair = members.to(device).nonzero().unbind(1)
        unit = self.space.to_unit(parameters.to(device))[row][:, None]
        last = last.to(device)
        size = max(1, _FRAMES_AT_ONCE // int(last.max()))
        means = dict.fromkeys(self.reported, 0.0)
        for shard in torch.split(torch.arange(len(pair), device=device), size):
            simulated = pair[shard]
            first = torch.zeros_like(simulated)
            losses = self.solver.segments(batch, simulated, first, last[simulated])
            frames = losses.simulated(losses.parameters(unit[shard]), gap=True)
            for name, objective in self.reported.items():
                loss = objective(frames, losses.segments.counted[..., None])
                means[name] += float(loss.sum()) / len(pair)
            memory.release()
        return means

    def _where_it_is_fast(self, batch: PairBatch) -> PairBatch:
        """Returns the pairs on the CPU if losses come from a compiled kernel there.

        On a GPU each step of a trajectory is a launch of its own: an H200 took twenty times as long
        for I-80's drivers as the kernel on 16 cores.
        """
        if batch.lengths.device.type != "cpu" and self.solver.has_kernel(batch[:1].to("cpu")):
            return batch.to("cpu")
        return batch

    def _has_kernel(self, batch: PairBatch) -> bool:
        """Says whether losses come from a compiled kernel here; asked where others solve them."""
        return self.engine.distributes and self.solver.has_kernel(batch)

    @property
    def _prior_key(self) -> dict[str, float]:
        if self.solver.prior == 0:
            return {}
        return {"prior": self.solver.prior}

    def _cached(
        self,
        what: str,
        keys: list[str],
        problems: list[int],
        shard: Callable[[Tensor, Tensor], CalibrationShard],
        at_most: int = _CLAIM,
        solver: Solver | None = None,
        **scope: Any,
    ) -> list[Arrays]:
        """Returns one entry per key; solves what neither the cache nor another process provides.

        Args:
            what: what is calibrated, for the progress display.
            keys: of the entries.
            problems: how many each entry stands for.
            shard: takes the numbers of entries, and those of the claim that they are cut from, and
                returns what solves these entries.
            at_most: problems in each shard, where claims are cut.
            solver: of these shards; the calibrator's own unless given.
            scope: settings that all keys share, besides those of the calibrator.
        """
        optimizer = (solver or self.solver).optimizer
        shard_size, enough = _CLAIM, float(_CLAIM)
        if optimizer.in_shards or (optimizer.in_threads and self.engine.distributes):
            shard_size = min(at_most, _CLAIM)
        if self.engine.distributes:
            # Its workers share all that there is: it is claimed at once.
            enough = math.inf
        evaluations = optimizer.evaluations(len(self.space))
        work = _Work(self.cache, keys, problems, evaluations, shard_size)
        missing = work.missing_by_cache_shard(self._key(what, "", **scope))
        with self.progress(self._title(what, work, optimizer), work.missing_evaluations) as task:
            while missing:
                with self.cache.claim(work.sizes(missing), enough) as claimed:
                    entries = {name: missing.pop(name) for name in claimed}
                    cuts = work.cut(entries, task)
                    shards = itertools.starmap(shard, cuts)
                    solved = self.engine.map(CalibrationShard.solve, shards, task.advance)
                    with closing(solved) as results:
                        for number, solution in results:
                            work.keep(cuts[number].entries, solution)
        return work.results()

    def _title(self, what: str, work: _Work, optimizer: Optimizer) -> str:
        """Returns what a progress display says."""
        objective = self.solver.objective
        minimised = type(objective).__name__
        if objective.unit:
            minimised = f"{minimised} in {objective.unit}"
        return f"{what} ({type(optimizer).__name__}, {minimised}, {work.missing_problems} problems)"

    def _solver_for(self, steps: int) -> Solver:
        """Returns the solver of a claim's problems, for any shard of it.

        Whether work is compiled depends on how much there is, and its last bits on that: `steps`
        of all problems of the claim, for one candidate.
        """
        evaluations = self.solver.optimizer.evaluations(len(self.space))
        stepper = self.solver.stepper.for_work(steps * evaluations)
        return replace(self.solver, stepper=stepper)

    @cached_property
    def _scope(self) -> dict[str, Any]:
        return self.solver.scope

    @cached_property
    def _code(self) -> str:
        return content_key(self._scope)

    def _key(self, what: str, pair: str, **details: Any) -> str:
        return content_key({"what": what, "pair": pair, **self._scope, **details})


class _Cut(NamedTuple):
    """Entries that one shard solves, and all of the claim that they are cut from: their numbers."""

    entries: Tensor
    claim: Tensor


class _Work:
    """The entries of one calibration: those cached, and those still to be solved.

    Attributes:
        evaluations: of each problem.
        missing_problems: problems of the entries that the cache did not hold at the start.
    """

    def __init__(
        self, cache: Cache, keys: list[str], problems: list[int], evaluations: int, shard_size: int
    ) -> None:
        self._cache = cache
        self._keys = keys
        self._problems = problems
        self._shard_size = shard_size
        self._entries = [cache.get(key) for key in keys]
        self.evaluations = evaluations
        self.missing_problems = self._size(self._missing(range(len(keys))))

    @property
    def missing_evaluations(self) -> int:
        """Evaluations of all problems that the cache did not hold at the start."""
        return self.missing_problems * self.evaluations

    def missing_by_cache_shard(self, scope: str) -> dict[str, list[int]]:
        """Returns the missing entries by the shard of the cache in which they are claimed."""
        missing = self._missing(range(len(self._keys)))
        by_shard = {}
        keys = [self._keys[index] for index in missing]
        for name, positions in self._cache.shards(keys, scope).items():
            by_shard[name] = [missing[position] for position in positions]
        return by_shard

    def sizes(self, entries: Mapping[str, list[int]]) -> dict[str, int]:
        """Returns how many problems the entries in each shard of the cache stand for."""
        return {name: self._size(indices) for name, indices in entries.items()}

    def cut(self, claimed: Mapping[str, list[int]], task: Task) -> list[_Cut]:
        """Cuts what is left of the entries in claimed shards of the cache into shards of work.

        Another process may have solved some before the claim. Shards of the cache are put together
        as an engine claims them that solves one claim after the other, so that every engine has the
        same claims.
        """
        cuts = []
        for names in first_fit(self.sizes(claimed), _CLAIM):
            indices: list[int] = []
            for name in names:
                indices += claimed[name]
            indices.sort()
            for index in indices:
                self._entries[index] = self._cache.get(self._keys[index])
            left = self._missing(indices)
            task.advance(self.evaluations * (self._size(indices) - self._size(left)))
            for claim in _in_order(left, self._problems, _CLAIM):
                for shard in _in_order(claim, self._problems, self._shard_size):
                    cuts.append(_Cut(torch.tensor(shard), torch.tensor(claim)))
        return cuts

    def keep(self, numbers: Tensor, entries: list[Arrays]) -> None:
        """Keeps the entries of these numbers, which were solved."""
        for index, entry in zip(numbers.tolist(), entries, strict=True):
            self._cache.put(self._keys[index], entry)
            self._entries[index] = entry

    def results(self) -> list[Arrays]:
        """Returns all entries."""
        return [entry for entry in self._entries if entry is not None]

    def _size(self, indices: Sequence[int]) -> int:
        return sum(self._problems[index] for index in indices)

    def _missing(self, indices: Sequence[int]) -> list[int]:
        return [index for index in indices if self._entries[index] is None]


def _in_order(indices: list[int], problems: list[int], at_most: int) -> Iterator[list[int]]:
    """Cuts indices, in order, where more than `at_most` problems would come together.

    One index that alone has more stands alone.
    """
    taken: list[int] = []
    size = 0
    for index in indices:
        if taken and size + problems[index] > at_most:
            yield taken
            taken, size = [], 0
        taken.append(index)
        size += problems[index]
    if taken:
        yield taken


def _group_key(pairs: Sequence[Pair] | PairSet, last: Tensor, members: Tensor) -> list[Any]:
    """Returns what identifies a group of pairs `(P,)` bool: each one's content and last frame."""
    identities = []
    for index in members.nonzero()[:, 0].tolist():
        identities.append((pairs[index].fingerprint, int(last[index])))
    return sorted(identities)


def _stacked(entries: list[Arrays], device: torch.device) -> Tensor:
    """Returns the entries' parameters `(entries, n)`."""
    rows = np.stack([entry["parameters"] for entry in entries])
    return torch.as_tensor(rows, device=device)
