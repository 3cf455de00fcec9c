"""The contract of a protocol: who is calibrated, trained and tested on what."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.calibrator import Calibrator, WindowLabels
from cfx.calibration.objectives import Objective
from cfx.core import registry
from cfx.core.component import Component
from cfx.core.engine import Engine
from cfx.core.parameters import ParameterSpace
from cfx.data.pairs import LearnedFrom, PairBatch, PairSet
from cfx.data.style import StyleResult
from cfx.errors import ConfigError, DataError, PluginError
from cfx.evaluation.closed_loop import (
    ClosedLoop,
    Followers,
    outside_of_scopes,
    simulate_in_shards,
)
from cfx.evaluation.evaluate import ComparedPairs, evaluate
from cfx.evaluation.metrics.base import MetricSet
from cfx.evaluation.result import Evaluation, Platoon
from cfx.learners.base import (
    CURVE_COLUMNS,
    Learner,
    TrainingData,
    TrainingPairs,
    TrainingResult,
)
from cfx.policies.agent import Agent, TrainedOn
from cfx.policies.base import Policy
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler, token_width
from cfx.policies.heads import head_class, head_name
from cfx.policies.heads.base import ParameterHead
from cfx.policies.population import DriverPopulation
from cfx.policies.valid_range import recorded_quantiles
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
        workspace: a folder where interrupted training finds what it needs to go on; None: training
            begins again.
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
    workspace: Path | None = None
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
    def _quantiles(self) -> dict[str, tuple[float, ...]]:
        """`TrainedOn.quantiles` of all agents here."""
        return recorded_quantiles(self.batch)

    @cached_property
    def _drivers(self) -> DriverPopulation | None:
        """`TrainedOn.drivers` of trained agents here."""
        return DriverPopulation.of(self.batch, self.policy.driver_features, self.pairs.drivers)

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

    def constant(self, policy: Policy, parameters: Tensor) -> Agent:
        """Returns an agent of a policy as built, without training: the baselines.

        Args:
            policy: the component.
            parameters: `(N, n)`, SI units: what `policy=fixed` answers, and recurrent networks
                start from; one network for each row.
        """
        names = tuple(str(number) for number in range(len(parameters)))
        return self.ready(policy, self.untrained(policy, parameters), names)

    def untrained(self, policy: Policy, parameters: Tensor) -> TrainingResult:
        """Returns a policy's networks as built; see `constant`.

        They are in double precision, so that constant parameters stay what calibration found.
        """
        space = self.stepper.model.space
        width = token_width(policy.inputs, policy.summary, self.windows.length)
        unit = space.to_unit(parameters.cpu())
        network = policy.build(
            width, space.to_unit(space.defaults()), unit, torch.Generator().manual_seed(self.seed)
        )
        scaler = Scaler(unit.new_zeros((len(unit), width)), unit.new_ones((len(unit), width)))
        device = parameters.device
        return TrainingResult(
            network.to(device).eval(),
            scaler.to(device),
            pd.DataFrame(columns=CURVE_COLUMNS),
            head=policy.untrained_head,
        )

    def ready(
        self, policy: Policy, training_result: TrainingResult, names: tuple[str, ...]
    ) -> Agent:
        """Returns an agent of trained networks; `names` says what each is for.

        Raises:
            PluginError: the learner or the policy did not deliver such networks.
        """
        who = registry.origin(self.learner if policy.trainable else policy)
        if not isinstance(training_result, TrainingResult):
            raise PluginError(
                f"{who}: fit must return a cfx.plugin.TrainingResult, but returned a"
                f" {type(training_result).__name__}"
            )
        head = self._head(policy, training_result)
        _check_networks(who, training_result, len(names), head.answers)
        # Constant parameters are calibrated on these pairs, too.
        learned_from = {pair.likeness: pair.driver for pair in self.pairs}
        return Agent(
            core=AgentCore(policy, training_result.network, training_result.scaler, head),
            model_node=self.model_node,
            policy_node=self.policy_node,
            windows=self.windows,
            dt=self.stepper.dt,
            names=names,
            base=training_result.base,
            trained_on=TrainedOn(
                learned_from, self._quantiles, drivers=self._drivers if policy.trainable else None
            ),
            valid_range=training_result.valid_range,
            dispersion=training_result.dispersion,
        )

    def _head(self, policy: Policy, training_result: TrainingResult) -> ParameterHead:
        """Returns the head that the learner trained its networks for."""
        has_base = training_result.base is not None
        name = training_result.head or head_name(has_base=has_base)
        if name not in registry.names("head"):
            raise PluginError(
                f"{registry.origin(self.learner)} breaks its contract: there is no head '{name}';"
                f" write one of {', '.join(registry.names('head'))}"
            )
        model = self.stepper.model
        head = head_class(name).for_model(model, training_result.scaler.mean.device)
        if policy.trainable and head.model_space != model.adaptation_space:
            log.info(
                "model.adaptation_bounds changes nothing here: this policy answers parameters,"
                " not offsets (learner=rollout, or learner.head=offset)"
            )
        return head


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


@torch.no_grad()
def _check_networks(
    who: str, training_result: TrainingResult, networks: int, parameters: int
) -> None:
    """Asks the networks about one window, so that a wrong shape or dtype ends in a sentence."""
    mean = training_result.scaler.mean
    expected = (networks, 1, 1, parameters)
    if mean.shape[0] == networks:
        tokens = mean.new_zeros((networks, 1, 1, mean.shape[1]))
        state = training_result.network.initial_state(networks, 1)
        answer, _ = training_result.network(tokens, state)
        finite = answer.isfinite().all() and mean.isfinite().all()
        if answer.shape == expected and answer.dtype == mean.dtype and not bool(finite):
            raise PluginError(
                f"{who}: its networks answer numbers that are not finite; train with a smaller"
                " learner.learning_rate, or repair it"
            )
        if answer.shape == expected and answer.dtype == mean.dtype:
            return
        got = (
            f"its networks answer {tuple(answer.shape)} in {answer.dtype} where {expected} in"
            f" {mean.dtype} are wanted"
        )
    else:
        got = f"its scaler is for {mean.shape[0]} networks where {networks} are wanted"
    raise PluginError(f"{who} breaks its contract: {got}")


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
