"""The calibrator: constant parameters of each driver, pooled ones, and those of each window.

All three are the same to an optimizer: independent problems, each the loss of segments simulated
from a measured state. Every result is cached on its own, so an interrupted calibration goes on
where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx import registry
from cfx.calibration.cache import Arrays, Cache
from cfx.calibration.losses import PooledLosses, SegmentLosses
from cfx.calibration.prior import LossesWithPrior
from cfx.calibration.windows import Windows, WindowSettings
from cfx.component import content_key, folder_hash
from cfx.errors import PluginError
from cfx.objectives.base import Objective
from cfx.objectives.rmse import SpeedRmse
from cfx.optimizers.base import Optimizer, Progress, Solution
from cfx.pairs import Pair, PairBatch, PairSet
from cfx.parameters import ParameterSpace
from cfx.progress import Task
from cfx.simulation.base import Stepper

_SAME_RELATIVE, _SAME_ABSOLUTE = 1e-5, 1e-8
"""How far a loss that is computed again may differ: candidates in another batch round otherwise."""

_GROUP = 1024
"""Problems solved together: enough to fill the batch, few enough that an interruption loses
little."""


@dataclass(frozen=True)
class Labels:
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

    def select(self, pairs: Tensor) -> Labels:
        """Returns the labels of some pairs, `(D,)` int64, which are numbered anew.

        A pair may stand there more than once.
        """
        windows, places = self.windows.select(pairs.cpu())
        places = places.to(self.loss.device)
        return Labels(
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
        columns: dict[str, Any] = {
            "pair_id": [pairs[index].pair_id for index in windows.pair.tolist()],
            "window": windows.number.numpy(),
            "time_s": windows.first.numpy() * pairs.dt,
        }
        for column, name in enumerate(names):
            columns[f"parameter_{name}"] = self.parameters[:, column].cpu().numpy()
        columns["loss"] = self.loss.cpu().numpy()
        columns["sensitivity"] = self.sensitivity.cpu().numpy()
        columns["diverged"] = self.diverged.cpu().numpy()
        return pd.DataFrame(columns)


class Calibrator:
    """Calibrates one model with one optimizer.

    Args:
        simulator: the model and its time step.
        optimizer: solves the problems.
        objective: what is minimised; RMSE of speed unless given.
        seed: the same seed gives the same parameters.
        cache: where results are kept.
        memory: bound for one chunk, bytes.
        progress: makes a progress display, given a description and a total.
        reported: objectives by name whose losses `losses` reports beside the minimised one.
        prior: weight of the prior on driver-specific and pooled parameters
            (`cfx.calibration.prior`); 0: none. Labels have none: ties go to the driver's own set.
    """

    def __init__(
        self,
        simulator: Stepper,
        optimizer: Optimizer,
        *,
        seed: int,
        cache: Cache,
        memory: int,
        progress: Callable[[str, int], Task],
        objective: Objective | None = None,
        reported: Mapping[str, Objective] | None = None,
        prior: float = 0.0,
    ) -> None:
        self.simulator = simulator
        self.optimizer = optimizer
        self.objective: Objective = SpeedRmse()
        if objective is not None:
            self.objective = objective
        self.seed = seed
        self.cache = cache
        self.memory = memory
        self.progress = progress
        self.reported = reported or {}
        self.prior = prior

    @property
    def space(self) -> ParameterSpace:
        """The model's parameter space."""
        return self.simulator.model.space

    def tie_tolerance(self, settings: WindowSettings) -> float:
        """Returns which losses of a window count as equal, in the objective's unit."""
        if settings.tie_tolerance is None:
            return self.objective.tie_tolerance
        return settings.tie_tolerance

    def fixed(self, pairs: PairSet, batch: PairBatch, last: Tensor) -> Tensor:
        """Finds one parameter set per pair: the driver-specific parameters.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            last: `(P,)`, the last frame that may be used; the pair is simulated from frame 0 to it
                in one closed loop.

        Returns:
            `(P, n)`, SI units.
        """
        device = batch.lengths.device
        last = last.to(device)
        keys = []
        for pair, end in zip(pairs, last.tolist(), strict=True):
            keys.append(self._key("fixed", pair.fingerprint, frames=end, **self._prior_key))

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            chosen = chosen.to(device)
            losses = self._segments(batch, chosen, last[chosen])
            return _rows(self._minimize_with_prior(losses, report))

        results = self._cached("Driver-specific parameters", keys, [1] * len(pairs), solve)
        return _stacked(results, device)

    def population(self, pairs: PairSet, batch: PairBatch, last: Tensor, members: Tensor) -> Tensor:
        """Finds one parameter set for each of K groups of pairs: the pooled parameters.

        Their loss is the mean of their pairs' losses: see `PooledLosses`.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            last: `(P,)`, the last frame that may be used of each.
            members: `(K, P)` bool, the pairs of each group; a pair may be in several.

        Returns:
            `(K, n)`, SI units.
        """
        device = batch.lengths.device
        members, last = members.cpu(), last.to(device)
        keys = []
        for row in members:
            group = _group_key(pairs, last, row)
            keys.append(self._key("population", "", pairs=group, **self._prior_key))

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            groups = members[chosen.cpu()].to(device)
            used = groups.any(0).nonzero()[:, 0]
            segments = self._segments(batch, used, last[used])
            losses = PooledLosses(segments, groups[:, used], self.memory)
            return _rows(self._minimize_with_prior(losses, report))

        results = self._cached("Pooled parameters", keys, [1] * len(members), solve)
        return _stacked(results, device)

    def labels(self, pairs: PairSet, batch: PairBatch, windows: Windows, fixed: Tensor) -> Labels:
        """Finds the parameters of each window; ties go to the driver-specific parameters.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            windows: W windows of these pairs.
            fixed: `(P, n)`, SI units: the first guess in each window, before the model's defaults.
        """
        device = batch.lengths.device
        counts = torch.bincount(windows.pair, minlength=len(pairs)).tolist()
        tolerance = self.tie_tolerance(windows.settings)
        description = {**windows.settings.model_dump(), "tie_tolerance": tolerance}
        keys = []
        for pair, count, row in zip(pairs, counts, fixed.tolist(), strict=True):
            keys.append(
                self._key("labels", pair.fingerprint, windows=count, fixed=row, **description)
            )
        defaults = self.space.defaults(device=device).expand_as(fixed)
        guesses = self.space.to_unit(torch.stack([fixed, defaults], dim=1))

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            own = torch.isin(windows.pair, chosen)
            pair, first = windows.pair[own].to(device), windows.first[own].to(device)
            steps = torch.full_like(first, windows.settings.length)
            losses = SegmentLosses.of_segments(
                self.simulator, self.objective, batch, pair, first, steps
            )
            found = self._minimize(losses, guesses[pair], report, tolerance)
            return _by_pair(found, windows.pair[own], chosen)

        title = "Per-window calibrated parameters (labels)"
        results = self._cached(title, keys, counts, solve, **description)
        joined = {}
        for name in results[0]:
            parts = np.concatenate([entry[name] for entry in results])
            joined[name] = torch.as_tensor(parts).to(device)
        return Labels(windows=windows, **joined)

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
        segments = self._segments(batch, pair, last.to(device)[pair])
        size = max(1, self.memory // max(1, segments.bytes_per_candidate))
        means = dict.fromkeys(self.reported, 0.0)
        for part in torch.split(torch.arange(len(pair), device=device), size):
            chosen = segments.take(part)
            frames = chosen.simulate(unit[part], gap=True)
            for name, objective in self.reported.items():
                loss = objective(frames, chosen.counted[..., None])
                means[name] += float(loss.sum()) / len(pair)
        return means

    def _segments(self, batch: PairBatch, pair: Tensor, last: Tensor) -> SegmentLosses:
        """Returns the losses of pairs `(S,)` from their frame 0 to a last one `(S,)`."""
        first = torch.zeros_like(pair)
        return SegmentLosses.of_segments(self.simulator, self.objective, batch, pair, first, last)

    def _defaults(self, problems: int, device: torch.device) -> Tensor:
        """Returns the model's defaults as the first guess of each problem, `(problems, 1, n)`."""
        guess = self.space.to_unit(self.space.defaults(device=device))
        return guess[None, None, :].expand(problems, 1, -1)

    @property
    def _prior_key(self) -> dict[str, float]:
        if self.prior == 0:
            return {}
        return {"prior": self.prior}

    def _minimize_with_prior(
        self, losses: SegmentLosses | PooledLosses, report: Progress
    ) -> Arrays:
        """Minimises from the model's defaults on; the loss returned is without the prior."""
        device = losses.device
        guesses = self._defaults(losses.problems, device)
        if self.prior == 0:
            return self._minimize(losses, guesses, report)
        default = self.space.to_unit(self.space.defaults(device=device))
        found = self._minimize(LossesWithPrior.of(losses, default, self.prior), guesses, report)
        best = torch.as_tensor(found["parameters"], device=device)
        unit = self.space.to_unit(best)[:, None]
        return {**found, "loss": losses(unit)[:, 0].cpu().numpy()}

    def _minimize(
        self,
        losses: SegmentLosses | PooledLosses | LossesWithPrior,
        guesses: Tensor,
        report: Progress,
        tolerance: float = 0.0,
    ) -> Arrays:
        solution = self.optimizer.minimize(
            losses.for_work(self.optimizer.evaluations()),
            guesses,
            seed=self.seed,
            objective_bytes=losses.bytes_per_candidate,
            memory=self.memory,
            progress=report,
            tolerance=tolerance,
        )
        self._check_losses(losses, solution)
        return {
            "parameters": self.space.from_unit(solution.best).cpu().numpy(),
            "loss": solution.loss.cpu().numpy(),
            "sensitivity": solution.sensitivity.cpu().numpy(),
            "diverged": solution.diverged.cpu().numpy(),
        }

    def _check_losses(
        self, losses: SegmentLosses | PooledLosses | LossesWithPrior, solution: Solution
    ) -> None:
        """Computes the losses of what a third party's optimizer returns once more.

        Raises:
            PluginError: it has mixed up its candidates.
        """
        if registry.is_own(self.optimizer):
            return
        again, found = losses(solution.best[:, None])[:, 0], solution.loss
        both = again.isfinite() & found.isfinite()
        same = torch.isclose(again, found, rtol=_SAME_RELATIVE, atol=_SAME_ABSOLUTE)
        wrong = both & ~same
        if bool(wrong.any()):
            at = int(wrong.nonzero()[0])
            raise PluginError(
                f"{registry.origin(self.optimizer)}: solve returned candidates with losses that are"
                f" not theirs: {float(found[at]):.6g} where the candidate has"
                f" {float(again[at]):.6g} ({int(wrong.sum())} of {len(found)} problems)"
            )

    def _cached(
        self,
        what: str,
        keys: list[str],
        problems: list[int],
        solve: Callable[[Tensor, Progress], list[Arrays]],
        **scope: Any,
    ) -> list[Arrays]:
        """Returns one entry per key; solves what neither the cache nor another process provides.

        Args:
            what: what is calibrated, for the progress display.
            keys: of the entries.
            problems: how many each entry stands for.
            solve: takes the numbers of entries and returns these entries.
            scope: settings that all keys share, besides those of the calibrator.
        """
        work = _Work(self.cache, keys, problems, self.optimizer.evaluations(), solve)
        wanted = work.shares(self._key(what, "", **scope))
        optimizer = type(self.optimizer).__name__
        objective = type(self.objective).__name__
        if self.objective.unit:
            objective = f"{objective} in {self.objective.unit}"
        title = f"{what} ({optimizer}, {objective}, {work.missing_problems} problems)"
        with self.progress(title, work.missing_problems * work.evaluations) as task:
            while wanted:
                sizes = {}
                for name, indices in wanted.items():
                    sizes[name] = work.size(indices)
                with self.cache.claim(sizes, _GROUP) as claimed:
                    mine = []
                    for name in claimed:
                        mine += wanted.pop(name)
                    work.do(sorted(mine), task)
        return work.results()

    def _key(self, what: str, pair: str, **details: Any) -> str:
        model = self.simulator.model
        parameters = [(p.name, p.low, p.high, p.default, p.tuned) for p in self.space]
        return content_key(
            {
                "what": what,
                "pair": pair,
                "dt": self.simulator.dt,
                "simulation": self.simulator.identity(),
                "calibration": folder_hash(__file__),
                "model": model.identity(),
                "parameters": parameters,
                "optimizer": self.optimizer.identity(),
                "objective": self.objective.identity(),
                "seed": self.seed,
                **details,
            }
        )


class _Work:
    """The entries of one calibration: what the cache holds, and what is still to be solved.

    Attributes:
        evaluations: of each problem.
        missing_problems: problems of the entries that the cache did not hold at the start.
    """

    def __init__(
        self,
        cache: Cache,
        keys: list[str],
        problems: list[int],
        evaluations: int,
        solve: Callable[[Tensor, Progress], list[Arrays]],
    ) -> None:
        self._cache = cache
        self._keys = keys
        self._problems = problems
        self._solve = solve
        self._entries = [cache.get(key) for key in keys]
        self.evaluations = evaluations
        self.missing_problems = self.size(self._missing(range(len(keys))))

    def shares(self, scope: str) -> dict[str, list[int]]:
        """Returns the missing entries by the share of the cache in which they are claimed."""
        missing = self._missing(range(len(self._keys)))
        shares = {}
        keys = [self._keys[index] for index in missing]
        for name, positions in self._cache.shares(keys, scope).items():
            shares[name] = [missing[position] for position in positions]
        return shares

    def size(self, indices: Sequence[int]) -> int:
        """Returns how many problems some entries stand for."""
        total = 0
        for index in indices:
            total += self._problems[index]
        return total

    def do(self, indices: list[int], task: Task) -> None:
        """Provides claimed entries: another process may have solved some before the claim."""
        for index in indices:
            self._entries[index] = self._cache.get(self._keys[index])
        left = self._missing(indices)
        task.advance(self.evaluations * (self.size(indices) - self.size(left)))
        for group in _groups(left, self._problems):
            solved = self._solve(torch.tensor(group), task.advance)
            for index, entry in zip(group, solved, strict=True):
                self._cache.put(self._keys[index], entry)
                self._entries[index] = entry

    def results(self) -> list[Arrays]:
        """Returns all entries."""
        return [entry for entry in self._entries if entry is not None]

    def _missing(self, indices: Sequence[int]) -> list[int]:
        return [index for index in indices if self._entries[index] is None]


def _groups(indices: list[int], problems: list[int]) -> Iterator[list[int]]:
    """Yields runs of indices with at most `_GROUP` problems, or one index if it alone has more."""
    group: list[int] = []
    size = 0
    for index in indices:
        if group and size + problems[index] > _GROUP:
            yield group
            group, size = [], 0
        group.append(index)
        size += problems[index]
    if group:
        yield group


def _group_key(pairs: Sequence[Pair] | PairSet, last: Tensor, members: Tensor) -> list[Any]:
    """Returns what identifies a group of pairs `(P,)` bool: each one's content and last frame."""
    found = []
    for index in members.nonzero()[:, 0].tolist():
        found.append((pairs[index].fingerprint, int(last[index])))
    return sorted(found)


def _rows(found: Arrays) -> list[Arrays]:
    """Returns an entry for each problem."""
    entries = []
    for number in range(len(found["loss"])):
        entries.append({name: values[number] for name, values in found.items()})
    return entries


def _by_pair(found: Arrays, pair: Tensor, chosen: Tensor) -> list[Arrays]:
    """Returns an entry for each chosen pair, with all its windows.

    Args:
        found: a row per window.
        pair: `(W,)`, the pair of each window.
        chosen: the pairs.
    """
    entries = []
    for number in chosen.tolist():
        own = (pair == number).numpy()
        entries.append({name: values[own] for name, values in found.items()})
    return entries


def _stacked(entries: list[Arrays], device: torch.device) -> Tensor:
    """Returns the entries' parameters `(entries, n)`."""
    rows = np.stack([entry["parameters"] for entry in entries])
    return torch.as_tensor(rows, device=device)
