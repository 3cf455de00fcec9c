"""The calibrator: fixed parameters of each pair, and the labels of each window.

Both are the same thing to an optimizer: independent problems, each a drive from a measured state. Pairs are solved in groups and
each pair's result is cached on its own, so an interrupted calibration goes on where it stopped.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.cache import Arrays, Cache
from cfx.calibration.objective import DriveObjective, JointObjective
from cfx.calibration.windows import Windows
from cfx.component import content_key, folder_hash
from cfx.optimizers.base import Optimizer, Progress
from cfx.pairs import PairBatch, PairSet
from cfx.progress import Task
from cfx.simulation.base import BaseSimulator

_GROUP = 1024
"""Problems solved together: enough to fill the batch, few enough that an interruption loses little."""


@dataclass(frozen=True)
class Labels:
    """The best parameters of each window.

    Attributes:
        windows: which windows.
        parameters: `(W, n)`, SI units: of those with a loss within `windows.tie_tolerance` of the lowest, the nearest to
            the pair's fixed parameters; so where nothing tells candidates apart they are the fixed parameters.
        loss: `(W,)`, RMSE of speed with these parameters, m/s.
        spread: `(W,)`, how much the choice of parameters matters there: median loss of the space-filling candidates minus
            `loss`, m/s. 0 where every candidate drives alike: such a label is arbitrary.
        diverged: `(W,)` int64, candidates whose loss was not a number.
    """

    windows: Windows
    parameters: Tensor
    loss: Tensor
    sensitivity: Tensor
    diverged: Tensor

    def select(self, pairs: Tensor) -> Labels:
        """Returns the labels of some pairs, `(D,)` int64, which are numbered anew; a pair may stand there more than once."""
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
        """Returns the means over windows, m/s: `labels/loss` and `labels/sensitivity`."""
        return {
            "labels/loss": float(self.loss.mean()),
            "labels/sensitivity": float(self.sensitivity.mean()),
        }

    def to_frame(self, pairs: PairSet, names: tuple[str, ...]) -> pd.DataFrame:
        """Returns a row per window: pair_id, window, time_s (its start), `parameter_NAME`, loss_mps, sensitivity_mps, diverged."""
        windows = self.windows
        ids = [pair.pair_id for pair in pairs]
        return pd.DataFrame(
            {
                "pair_id": [ids[index] for index in windows.pair.tolist()],
                "window": windows.number.numpy(),
                "time_s": windows.first.numpy() * pairs.dt,
                **{
                    f"parameter_{name}": column.cpu().numpy()
                    for name, column in zip(names, self.parameters.T, strict=True)
                },
                "loss_mps": self.loss.cpu().numpy(),
                "sensitivity_mps": self.sensitivity.cpu().numpy(),
                "diverged": self.diverged.cpu().numpy(),
            }
        )


class Calibrator:
    """Calibrates one model with one optimizer.

    Args:
        simulator: the model and its time step.
        optimizer: solves the problems.
        seed: the same seed gives the same parameters.
        cache: where results are kept.
        memory: bound for one chunk, bytes.
        progress: makes a progress display, given a description and a total.
    """

    def __init__(
        self,
        simulator: BaseSimulator,
        optimizer: Optimizer,
        *,
        seed: int,
        cache: Cache,
        memory: int,
        progress: Callable[[str, int], Task],
    ) -> None:
        self.simulator = simulator
        self.optimizer = optimizer
        self.seed = seed
        self.cache = cache
        self.memory = memory
        self.progress = progress

    @property
    def space(self) -> Any:
        """The model's parameter space."""
        return self.simulator.model.space

    def fixed(self, pairs: PairSet, batch: PairBatch, last: Tensor) -> Tensor:
        """Finds one parameter set per pair.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            last: `(P,)`, the last frame that may be used; the drive is simulated from frame 0 to it as one closed loop.

        Returns:
            `(P, n)`, SI units.
        """
        device = batch.lengths.device
        last = last.to(device)
        keys = [
            self._key("fixed", pair.fingerprint, frames=int(end))
            for pair, end in zip(pairs, last, strict=True)
        ]
        guess = self.space.to_unit(self.space.defaults(device=device))[None, None, :]

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            chosen = chosen.to(device)
            objective = DriveObjective.of_segments(
                self.simulator, batch, chosen, torch.zeros_like(chosen), last[chosen]
            )
            found = self._minimize(objective, guess.expand(len(chosen), 1, -1), report)
            return [{name: values[i] for name, values in found.items()} for i in range(len(chosen))]

        results = self._cached("Fixed parameters", keys, [1] * len(pairs), solve)
        return torch.stack(
            [torch.as_tensor(entry["parameters"], device=device) for entry in results]
        )

    def population(self, pairs: PairSet, batch: PairBatch, last: Tensor, members: Tensor) -> Tensor:
        """Finds one parameter set for each of K groups of pairs, calibrated jointly: see `JointObjective`.

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
        keys = [
            self._key(
                "population",
                "",
                pairs=sorted(
                    (pairs[i].fingerprint, int(last[i])) for i in row.nonzero()[:, 0].tolist()
                ),
            )
            for row in members
        ]
        guess = self.space.to_unit(self.space.defaults(device=device))[None, None, :]

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            groups = members[chosen.cpu()].to(device)
            drives = groups.any(0).nonzero()[:, 0]
            segments = DriveObjective.of_segments(
                self.simulator, batch, drives, torch.zeros_like(drives), last[drives]
            )
            objective = JointObjective(segments, groups[:, drives], self.memory)
            found = self._minimize(objective, guess.expand(len(chosen), 1, -1), report)
            return [{name: values[i] for name, values in found.items()} for i in range(len(chosen))]

        results = self._cached("Population's parameters", keys, [1] * len(members), solve)
        return torch.stack(
            [torch.as_tensor(entry["parameters"], device=device) for entry in results]
        )

    def labels(self, pairs: PairSet, batch: PairBatch, windows: Windows, fixed: Tensor) -> Labels:
        """Finds the parameters of each window; ties go to the pair's fixed parameters.

        Args:
            pairs: P pairs.
            batch: the same as tensors.
            windows: W windows of these pairs.
            fixed: `(P, n)`, SI units: the first guess in each window, before the model's defaults.
        """
        device = batch.lengths.device
        counts = torch.bincount(windows.pair, minlength=len(pairs))
        description = windows.settings.model_dump()
        keys = [
            self._key(
                "labels", pair.fingerprint, windows=int(count), fixed=row.tolist(), **description
            )
            for pair, count, row in zip(pairs, counts, fixed, strict=True)
        ]
        guesses = self.space.to_unit(
            torch.stack([fixed, self.space.defaults(device=device).expand_as(fixed)], dim=1)
        )

        def solve(chosen: Tensor, report: Progress) -> list[Arrays]:
            own = torch.isin(windows.pair, chosen)
            pair, first = windows.pair[own].to(device), windows.first[own].to(device)
            objective = DriveObjective.of_segments(
                self.simulator, batch, pair, first, torch.full_like(first, windows.settings.length)
            )
            found = self._minimize(objective, guesses[pair], report, windows.settings.tie_tolerance)
            return [
                {name: values[windows.pair[own] == p] for name, values in found.items()}
                for p in chosen
            ]

        results = self._cached("Window labels", keys, counts.tolist(), solve, **description)
        joined = {
            name: torch.cat([torch.as_tensor(entry[name]) for entry in results]).to(device)
            for name in results[0]
        }
        return Labels(windows=windows, **joined)

    def _minimize(
        self,
        objective: DriveObjective | JointObjective,
        guesses: Tensor,
        report: Progress,
        tolerance: float = 0.0,
    ) -> Arrays:
        solution = self.optimizer.minimize(
            objective,
            guesses,
            seed=self.seed,
            objective_bytes=objective.bytes_per_candidate,
            memory=self.memory,
            progress=report,
            tolerance=tolerance,
        )
        found = {
            "parameters": self.space.from_unit(solution.best),
            "loss": solution.loss,
            "sensitivity": solution.sensitivity,
            "diverged": solution.diverged,
        }
        return {name: values.cpu().numpy() for name, values in found.items()}

    def _cached(
        self,
        what: str,
        keys: list[str],
        problems: list[int],
        solve: Callable[[Tensor, Progress], list[Arrays]],
        **scope: Any,
    ) -> list[Arrays]:
        """Returns one entry per key, solving in groups what neither the cache holds nor another process is solving.

        Args:
            problems: how many each entry stands for.
            scope: settings that all keys share, besides those of the calibrator.
        """
        entries = [self.cache.get(key) for key in keys]
        missing = [index for index, entry in enumerate(entries) if entry is None]
        todo = sum(problems[index] for index in missing)
        each = self.optimizer.evaluations()
        shares = self.cache.shares([keys[index] for index in missing], self._key(what, "", **scope))
        wanted = {
            name: [missing[position] for position in positions]
            for name, positions in shares.items()
        }
        with self.progress(f"{what} ({self.optimizer_name}, {todo} problems)", todo * each) as task:
            while wanted:
                sizes = {
                    name: sum(problems[index] for index in indices)
                    for name, indices in wanted.items()
                }
                with self.cache.claim(sizes, _GROUP) as claimed:
                    mine = sorted(index for name in claimed for index in wanted.pop(name))
                    for index in mine:  # another process may have solved them before the claim
                        entries[index] = self.cache.get(keys[index])
                    task.advance(
                        each * sum(problems[index] for index in mine if entries[index] is not None)
                    )
                    for group in _groups(
                        [index for index in mine if entries[index] is None], problems
                    ):
                        for index, entry in zip(
                            group, solve(torch.tensor(group), task.advance), strict=True
                        ):
                            self.cache.put(keys[index], entry)
                            entries[index] = entry
        return [entry for entry in entries if entry is not None]

    @functools.cached_property
    def optimizer_name(self) -> str:
        """The optimizer's class name, for people."""
        return type(self.optimizer).__name__

    def _key(self, what: str, pair: str, **details: Any) -> str:
        model = self.simulator.model
        return content_key(
            {
                "what": what,
                "pair": pair,
                "dt": self.simulator.dt,
                "simulation": self.simulator.identity(),
                "calibration": folder_hash(__file__),
                "model": model.identity(),
                "parameters": [(p.name, p.low, p.high, p.default, p.tuned) for p in self.space],
                "optimizer": self.optimizer.identity(),
                "seed": self.seed,
                **details,
            }
        )


def _groups(indices: list[int], problems: list[int]) -> Iterator[list[int]]:
    """Yields runs of indices with at most `_GROUP` problems together, or one index if it alone has more."""
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
