"""Who may enter the benchmark: cfx's own methods, by jobs, and rivals, fold by fold.

An entry gives a driver for each fold. Constant parameters are pooled for all folds of a scheme at
once, and policies of cfx are trained so by one job; a rival learns from the pairs of one fold after
the other.

Shapes: P pairs, T frames, n tuned parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pandas as pd
import torch
from torch import Tensor

import cfx
from cfx.errors import ConfigError, DataError
from cfx.plugin import (
    Agent,
    DrivingModel,
    FixedPolicy,
    Followers,
    MemoryStepper,
    PairBatch,
    PairSet,
    base_of,
    files,
    forecasts,
    load_agent,
    registry,
)
from cfx_report.benchmark.constants import ConstantDriver, calibration_settings
from cfx_report.benchmark.frozen import HISTORY
from cfx_report.benchmark.jobs import run_job
from cfx_report.benchmark.rival import Driver, Rival, on_frames
from cfx_report.benchmark.suite import Scheme, Suite


@dataclass(frozen=True)
class Training:
    """What a scheme gives to learn from.

    Attributes:
        suite: that asks.
        scheme: how drivers are divided.
        pairs: P of them.
        fold: in which each is tested, `(P,)`.
        recording: the file that jobs read.
        folder: of the row; a job has one of its own there.
        seed: of everything that is left to chance.
    """

    suite: Suite
    scheme: Scheme
    pairs: PairSet
    fold: Tensor
    recording: Path
    folder: Path
    seed: int

    @property
    def folds(self) -> int:
        """How many there are."""
        return int(self.fold.max()) + 1

    def tested(self, number: int) -> PairSet:
        """Returns the pairs that are tested in a fold."""
        return self.pairs.take((self.fold == number).nonzero()[:, 0].tolist())

    def learned(self, number: int) -> PairSet:
        """Returns the pairs that a fold learns from."""
        elsewhere = (self.fold != number) & (self.fold != -2 - number)
        return self.pairs.take(elsewhere.nonzero()[:, 0].tolist())


class Entry(ABC):
    """What enters the benchmark.

    Attributes:
        name: of its row.
        words: that give it on the command line.
    """

    name: str
    words: tuple[str, ...]

    @abstractmethod
    def driver(self, training: Training, number: int) -> Driver:
        """Returns what drives in a fold, after it has learned."""

    @abstractmethod
    def learned(self, pairs: PairSet, seed: int) -> Driver:
        """Returns what drives after it has learned from these pairs, where there are no folds.

        Raises:
            ConfigError: only a job can train it.
        """


@dataclass(frozen=True)
class RivalEntry(Entry):
    """A rival: `rival=ridge rival.alpha=3`."""

    name: str
    words: tuple[str, ...]
    rival: Rival

    def driver(self, training: Training, number: int) -> Driver:
        return self.learned(training.learned(number), training.seed)

    def learned(self, pairs: PairSet, seed: int) -> Driver:
        return self.rival.fit(pairs, seed)


@dataclass(frozen=True)
class ReadyEntry(Entry):
    """A policy that was trained before: `driver=cfx://idm`, or the folder of a job."""

    name: str
    words: tuple[str, ...]
    agent: Agent

    def driver(self, training: Training, number: int) -> Driver:
        raise ConfigError(
            f"{self.words[0]}: has learned from drivers whom the suite tests; enter the overrides"
            " of its job"
        )

    def learned(self, pairs: PairSet, seed: int) -> Driver:
        return AgentDriver(self.agent, 0, {})


@dataclass(frozen=True)
class ConstantEntry(Entry):
    """A model with constant parameters, pooled over the drivers that a fold learns from.

    All folds of a scheme are pooled at once, since they have candidates in common.

    Attributes:
        overrides: the words, and those that change no result.
    """

    name: str
    words: tuple[str, ...]
    overrides: tuple[str, ...]

    def driver(self, training: Training, number: int) -> Driver:
        found = training.folder / f"pooled_{training.scheme.name}.parquet"
        if not found.is_file():
            groups = {}
            for fold in range(training.folds):
                groups[str(fold)] = training.learned(fold).ids
            table = self._pooled(training.pairs, training.seed, groups)
            training.folder.mkdir(parents=True, exist_ok=True)
            with files.atomic_write(found) as temporary:
                table.to_parquet(temporary)
        return self._driver(pd.read_parquet(found).loc[[str(number)]])

    def learned(self, pairs: PairSet, seed: int) -> Driver:
        return self._driver(self._pooled(pairs, seed))

    def _pooled(
        self, pairs: PairSet, seed: int, groups: Mapping[str, Sequence[str]] | None = None
    ) -> pd.DataFrame:
        settings = calibration_settings(self.overrides)
        return cfx.calibrate_pooled(pairs, groups=groups, seed=seed, **settings)

    def _driver(self, parameters: pd.DataFrame) -> Driver:
        return ConstantDriver(calibration_settings(self.overrides), parameters)


@dataclass(frozen=True)
class JobEntry(Entry):
    """A model or a policy of cfx: the overrides of a job.

    Attributes:
        overrides: the words, and those that change no result, such as where it is tracked.
    """

    name: str
    words: tuple[str, ...]
    overrides: tuple[str, ...]

    def driver(self, training: Training, number: int) -> Driver:
        job = self.job(training)
        agent = load_agent(job / "policy")
        if agent.names[number] != f"fold {number}":
            raise DataError(f"{job}: has no policy for each fold; its protocol is another one")
        return AgentDriver(agent, number, calibration_settings(self.overrides))

    def learned(self, pairs: PairSet, seed: int) -> Driver:
        raise ConfigError(
            f"{' '.join(self.words)}: only a job trains it: run that, and give driver=FOLDER"
        )

    def job(self, training: Training) -> Path:
        """Runs the job of a scheme, or finds it finished; returns its folder.

        Raises:
            DataError: it failed, or its folds are not the benchmark's.
        """
        scheme = training.scheme
        job = training.folder / "jobs" / scheme.name
        folds = "null" if scheme.folds is None else str(scheme.folds)
        shortest = training.suite.min_test_duration
        history = [word for word in self.overrides if word.startswith(f"{HISTORY}=")]
        overrides = [
            *self.overrides,
            *training.suite.job,
            f"protocol.min_test_duration={'null' if shortest is None else f'{shortest:g}'}",
            "protocol.combine=false",
            *history,
            f"protocol.together={scheme.together}",
            f"protocol.folds={folds}",
            f"seed={training.seed}",
            files.path_override("data.path", training.recording.absolute()),
        ]
        run_job(overrides, job)
        table = pd.read_csv(job / "pairs.csv").drop_duplicates("pair_id")
        fold = table.set_index(table["pair_id"].astype(str))["fold"]
        tested = (training.fold >= 0).nonzero()[:, 0].tolist()
        ids = [training.pairs.ids[number] for number in tested]
        if fold.reindex(ids).tolist() != training.fold[tested].tolist():
            raise DataError(f"{job}: tests other folds than {training.suite.version}")
        return job


class AgentDriver(Driver):
    """A model whose parameters are constant, or chosen by a policy.

    Args:
        agent: of a job, with a network or pooled parameters for each fold.
        number: of the fold.
        settings: of calibration, as `cfx.calibrate` takes them, for drivers whose past is given.
        driver_specific: their parameters, `(P, n)`, SI units; None: nothing is known of anybody.
    """

    def __init__(
        self,
        agent: Agent,
        number: int,
        settings: Mapping[str, Any],
        driver_specific: Tensor | None = None,
    ) -> None:
        self.agent = agent
        self.number = number
        self.is_stochastic = agent.core.head.is_stochastic
        self._settings = settings
        self._driver_specific = driver_specific
        self._model = cast(DrivingModel, registry.create("model", agent.model_node))

    def drive(self, batch: PairBatch, first: Tensor, seed: int | None) -> Tensor:
        base = None
        if self._driver_specific is not None:
            base = base_of(self.agent, self._driver_specific)
        network = torch.full_like(first, self.number)
        # A policy reads as much of the past as it has learned to. Those that learned from cold
        # starts alone err more after they have read, by 1 % in the suite's task `known`.
        followers = Followers(batch, network, base, self.agent.context_rule.history_s)
        generator = None
        if seed is not None and self.is_stochastic:
            generator = torch.Generator().manual_seed(seed)
        paths = forecasts.sample_from_origins(
            MemoryStepper(self._model, batch.dt, compile="never"),
            self.agent,
            followers,
            forecasts.Origins(torch.arange(len(first)), first),
            int((batch.lengths - 1 - first).max()),
            [generator],
        )
        return on_frames(paths.speed[0], batch, first)

    def adapted(self, past: PairSet, seed: int) -> Driver:
        """Calibrates driver-specific parameters on their past, where they drive or are a base."""
        is_constant = isinstance(self.agent.core.policy, FixedPolicy)
        if not (is_constant or self.agent.context_rule.driver_specific):
            return self
        fit = cfx.calibrate(past, split=1.0, seed=seed, **self._settings)
        if is_constant:
            return ConstantDriver(self._settings, fit.parameters)
        values = torch.tensor(fit.parameters.to_numpy(dtype="float64"))
        return AgentDriver(self.agent, self.number, self._settings, values)
