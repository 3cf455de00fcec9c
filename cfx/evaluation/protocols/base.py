"""The contract of a protocol: who is calibrated, trained and tested on what."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import pandas as pd
from torch import Tensor

from cfx.calibration.calibrator import Calibrator, WindowLabels
from cfx.calibration.objectives import Objective
from cfx.core.component import Component
from cfx.core.engine import Engine
from cfx.core.parameters import ParameterSpace
from cfx.data.pairs import LearnedFrom, PairBatch, PairSet
from cfx.data.style import StyleResult
from cfx.errors import ConfigError, DataError
from cfx.evaluation.closed_loop import (
    ClosedLoop,
    Followers,
    outside_of_scopes,
    simulate_in_shards,
)
from cfx.evaluation.evaluate import ComparedPairs, evaluate
from cfx.evaluation.metrics.base import MetricSet
from cfx.evaluation.protocols.agents import AgentBuilder
from cfx.evaluation.result import Evaluation, Platoon
from cfx.learners.base import (
    Learner,
    TrainingData,
    TrainingPairs,
)
from cfx.learners.workspace import Workspace
from cfx.policies.agent import Agent
from cfx.policies.base import Policy
from cfx.simulation.base import Stepper
from cfx.simulation.windows import Windows, WindowSettings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ProtocolContext:
    """Everything that a protocol composes.

    Attributes:
        pairs, batch: the trajectories, as objects and as tensors on the job's device.
        style: score and cluster of each driver.
        model_node, policy_node: config nodes, kept with the trained policy.
        calibrator, policy, learner: the components.
        windows: how trajectories are cut.
        split: share of each pair's windows for training.
        metrics: what is measured; None: cfx's own metrics.
        workspace: where interrupted training finds what it needs to go on; None: training begins
            again.
    """

    pairs: PairSet
    batch: PairBatch
    style: StyleResult
    model_node: Mapping[str, Any]
    policy_node: Mapping[str, Any]
    calibrator: Calibrator
    policy: Policy
    learner: Learner
    windows: WindowSettings
    split: float
    workspace: Workspace | None = None
    metrics: MetricSet | None = None

    @property
    def stepper(self) -> Stepper:
        """The driving model and its time step."""
        return self.calibrator.solver.stepper

    @property
    def seed(self) -> int:
        """For everything random."""
        return self.calibrator.solver.seed

    @property
    def space(self) -> ParameterSpace:
        """The driving model's parameters."""
        return self.stepper.model.space

    @property
    def objective(self) -> Objective:
        """What calibration minimises and closed-loop training back-propagates."""
        return self.calibrator.solver.objective

    @property
    def engine(self) -> Engine:
        """Where calibration, training and evaluation run."""
        return self.calibrator.engine

    def refuse_segments(self) -> None:
        """Refuses a setting of pooled parameters where a job calibrates none.

        Raises:
            ConfigError: it has a value.
        """
        length = self.calibrator.solver.pooled_segment_s
        if length is not None:
            raise ConfigError(
                f"calibration.pooled_segment_s={length:g}: this job calibrates no pooled"
                " parameters, so it does nothing; leave it out, or set protocol=across_drivers"
            )

    @cached_property
    def agents(self) -> AgentBuilder:
        """What makes agents of constant parameters and of trained networks."""
        return AgentBuilder(
            pairs=self.pairs,
            batch=self.batch,
            model_node=self.model_node,
            policy_node=self.policy_node,
            stepper=self.stepper,
            learner=self.learner,
            windows=self.windows,
            seed=self.seed,
        )

    def labels(self, counts: Tensor, fixed: Tensor) -> WindowLabels | None:
        """Calibrates parameters per window (labels), if the learner needs any.

        Args:
            counts: `(P,)`, how many windows of each pair, from its first.
            fixed: `(P, n)`, driver-specific parameters.
        """
        if not (self.policy.trainable and self.learner.needs_labels):
            return None
        labels = self.calibrator.labels(
            self.pairs, self.batch, Windows.of(counts, self.windows), fixed
        )
        tolerance = self.calibrator.tie_tolerance(self.windows)
        sensitive = float((labels.sensitivity > tolerance).double().mean())
        log.info(
            "Per-window calibrated parameters (labels): %d windows; the choice of parameters"
            " changes the loss by more than %s in %.0f %% of them",
            len(labels.windows),
            self.objective.worded(tolerance),
            100 * sensitive,
        )
        return labels

    def calibration_metrics(
        self, method: str, last: Tensor, parameters: Tensor, members: Tensor | None = None
    ) -> dict[str, float]:
        """Returns mean losses of constant parameters on the data that they were calibrated on.

        The metrics are called `calibration/OBJECTIVE/METHOD`.

        Args:
            method: what the parameters are called in metrics: `driver_specific` or `pooled`.
            last: `(P,)`, the last frame of each pair's calibrated part.
            parameters: `(P, n)`, one set per pair; with `members` `(K, n)`, one per group. SI
                units.
            members: `(K, P)` bool, the pairs of each group.
        """
        losses = self.calibrator.losses(self.batch, last, parameters, members)
        return {f"calibration/{name}/{method}": loss for name, loss in losses.items()}

    def check_start(self, tested: PairSet) -> None:
        """Checks that networks begin with nothing learned from the pairs that are tested.

        Raises:
            DataError: they have learned from some.
        """
        if not self.policy.trainable:
            return
        learned_from = LearnedFrom(self.learner.learned_before)
        not_new = tested.select([pair in learned_from for pair in tested], "learned from").ids
        if not_new:
            raise DataError(
                f"learner.start: that policy has learned from {len(not_new)} of the {len(tested)}"
                f" pairs that are tested here, the first of them '{not_new[0]}'; test on others"
                " (data.recording, data.pair_ids)"
            )

    def training_data(self, pairs: TrainingPairs, names: tuple[str, ...]) -> TrainingData:
        """Returns what the learner is given: some of the pairs, and a name for each network."""
        return TrainingData(
            stepper=self.stepper,
            recorded=self.batch,
            pairs=pairs,
            windows=self.windows,
            names=names,
            seed=self.seed,
            objective=self.objective,
            workspace=self.workspace,
            engine=self.engine,
        )

    def simulated(self, agent: Agent, followers: Followers, first: Tensor) -> ClosedLoop:
        """Simulates followers from frames `first` on; see `simulate_in_shards`."""
        return simulate_in_shards(self.engine, self.stepper, agent, followers, first)

    def compared(
        self,
        tested: ComparedPairs,
        scopes: Mapping[str, Mapping[str, ClosedLoop]],
        policy: Agent,
        platoon: Platoon | None,
    ) -> Evaluation:
        """Measures closed loops of all methods; `scopes` as for `evaluate`."""
        evaluation = evaluate(
            tested,
            scopes,
            self.space,
            policy_space=policy.core.head.model_space,
            metrics=self.metrics,
        )
        return replace(evaluation, platoon=platoon, outside=outside_of_scopes(policy, scopes))

    def defaults(self, like: Tensor) -> Tensor:
        """Returns the model's default parameters `(n,)`, SI units, in the dtype of others."""
        return self.space.defaults(dtype=like.dtype, device=like.device)


@dataclass(frozen=True)
class ProtocolResult:
    """What a protocol delivers.

    Attributes:
        evaluation: the comparison of all methods.
        policy: the policy that drove in it.
        curves: learning curves; empty if nothing was learned.
        labels: per-window calibrated parameters; None if none were needed.
        calibration: further metrics, of the calibration itself:
            `ProtocolContext.calibration_metrics`.
        notes: what a reader of the results should know of the design, name -> a number or text;
            kept in `data.json`.
    """

    evaluation: Evaluation
    policy: Agent
    curves: pd.DataFrame
    labels: WindowLabels | None
    notes: Mapping[str, Any] = field(default_factory=dict)
    calibration: Mapping[str, float] = field(default_factory=dict)


class Protocol(Component):
    """Base of every protocol.

    Life cycle: a job calls `determines` and then `run`, once each. All methods are tested on the
    same frames from the same measured state.

    Attributes:
        jobs: settings that name the output folders of finished jobs. Where one is the id of an
            MLflow run, the job puts the folder with that run's files in its place.
    """

    kind = "protocol"
    jobs: ClassVar[tuple[str, ...]] = ()

    @property
    def trains(self) -> bool:
        """Whether it has a `trainable` policy trained; not if it brings one."""
        return True

    def determines(self) -> Mapping[str, Any]:
        """Returns what this protocol determines of a job's configuration: key -> value.

        It holds whatever else is chosen there.

        Raises:
            DataError: it depends on something that cannot be read.
        """
        return {}

    @abstractmethod
    def run(self, context: ProtocolContext) -> ProtocolResult:
        """Calibrates, trains and evaluates."""
