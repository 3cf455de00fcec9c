"""The learner `rollout`.

Where the data do not determine the labels of windows, their average means little
(`cfx.learners.imitation`).
Here nothing is labelled: from random measured states on, the policy drives in closed loop behind
the measured leader, and the job's objective is propagated back through the simulation into the
network.

Shapes: N networks (each member of an ensemble counts), n tuned parameters.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.core.engine import Engine
from cfx.core.progress import Task
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.curves import warn_of_nothing_learned
from cfx.learners.rollout.dataset import RolloutDataset, time_gaps
from cfx.learners.rollout.sampling import Augmentation
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.rollout.shard import (
    TrainedShard,
    TrainingShard,
    checkpoint_path,
    cut,
    epochs,
    expert_checkpoint,
    networks_of_shards,
    shard_checkpoints,
    untrained,
)
from cfx.learners.rollout.start import begun, check_start, start_policy
from cfx.learners.situations import learned_range
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.core import Ensemble
from cfx.policies.features import Scaler
from cfx.policies.heads import head_class
from cfx.policies.heads.base import ParameterHead

log = logging.getLogger(__name__)


class RolloutLearner(Learner):
    """Back-propagates the job's objective through closed-loop simulation into the policy.

    Networks answer offsets (`cfx.policies.heads.offset`): untrained, each driver is driven by their
    base parameters, so training starts from a fixed model. With `head=residual` they also choose
    how the model takes over from the acceleration at the start (`cfx.policies.heads.residual`).

    Before a trajectory the policy observes the driver's measured history; cold starts, as of unseen
    drivers, have none. The drivers of all networks (at most `drivers` of each) are simulated at
    once, from random measured states. The switches of models with regimes are smoothed meanwhile;
    validation is exact. Networks can first imitate experts that set the acceleration
    (`distillation_epochs`).

    A trajectory's loss is the objective plus `gap_weight` times the gap's RMSE, each divided by
    what the base parameters have there, plus `jerk_weight` times the RMS jerk.

    Training goes on where it was interrupted, and gives the same then, if the training data has a
    workspace.

    Differences from the paper: the paper imitates labels.
    """

    schema: ClassVar[type[Settings]] = RolloutSettings
    settings: RolloutSettings
    needs_gradients = True
    uses_driver_features = True
    trial: ClassVar[Mapping[str, Any]] = {
        "ensemble_size": 2,
        "distillation_epochs": 1,
        "epochs": 3,
        "steps": 6,
        "horizon": 5,
        "learning_rate": 0.1,
    }

    @property
    def reads_history(self) -> bool:
        return self.settings.cold_start_fraction < 1.0

    @property
    def learned_before(self) -> Mapping[str, str]:
        # Of one network among several nobody knows which pairs it was kept from.
        start = self.settings.start
        if start is None or "#" in start:
            return {}
        return start_policy(start).trained_on.pairs

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """As `Learner.fit`.

        Raises:
            ConfigError: the simulator or the model has no gradients.
        """
        simulator, s = training_data.simulator, self.settings
        if policy.adapts:
            self.require_gradients(simulator.model, simulator.differentiable)
        if not {"gap", "time_headway"} & set(policy.inputs):
            log.info(
                "The policy does not see the gap; policy.inputs=situation gives smaller errors"
            )
        generator = torch.Generator().manual_seed(training_data.seed)
        head = head_class(s.head).for_model(simulator.model)
        dataset = RolloutDataset.of(
            training_data, policy, s.validation, generator, s.ensemble_size, head, s.balance
        )
        network = untrained(policy, dataset, head, generator)
        start = None
        if s.start is not None:
            start = start_policy(s.start).to(training_data.device)
            check_start(s.start, start, policy, training_data, head)
            network, dataset = begun(start, network, dataset)
        if not any(parameter.requires_grad for parameter in network.parameters()):
            curves = pd.DataFrame(columns=CURVE_COLUMNS)
            return self._result(network.eval(), dataset, training_data, curves)
        checkpoint = self.checkpoint(policy, training_data)
        networks = networks_of_shards(s, dataset)
        shards = cut(s, policy, training_data, dataset, network, networks, checkpoint)
        curves, dispersion = self._train(
            shards, len(networks), training_data.engine, network, dataset
        )
        for file in shard_checkpoints(checkpoint, networks):
            if file is not None:
                file.unlink(missing_ok=True)
                expert_checkpoint(file).unlink(missing_ok=True)
        found = self._result(network.eval(), dataset, training_data, curves)
        if start is not None and start.valid_range is not None and found.valid_range is not None:
            found = replace(found, valid_range=found.valid_range.joined(start.valid_range))
        return replace(found, dispersion=dispersion)

    def _train(
        self,
        shards: Iterable[TrainingShard],
        count: int,
        engine: Engine,
        network: PolicyNetwork,
        dataset: RolloutDataset,
    ) -> tuple[pd.DataFrame, Tensor | None]:
        """Trains all networks in place, in `count` shards.

        Returns:
            The learning curves, and the dispersion of each ensemble's noise; None for a head
            without noise.
        """
        at_most = epochs(self.settings)
        # Where nothing is trained, its imports would only take time and memory.
        from cfx.learners.rollout.train import train

        title = f"Training ({len(dataset.pair)} networks, at most {at_most} epochs)"
        with Task(title, at_most * count) as task:
            trained: dict[int, TrainedShard] = dict(
                engine.map(train, shards, task.advance, shares_cores=count == 1)
            )
        in_order = [trained[number] for number in range(count)]
        weights = {}
        for name in network.state_dict():
            weights[name] = torch.cat([found.weights[name] for found in in_order])
        network.load_state_dict(weights)
        curves = pd.concat([found.curves for found in in_order], ignore_index=True)
        curves = curves.sort_values("epoch", kind="stable", ignore_index=True)
        warn_of_nothing_learned(curves)
        factors = []
        for found in in_order:
            if found.dispersion is not None:
                factors.append(found.dispersion)
        dispersion = None
        if factors:
            # The geometric mean of an ensemble's members.
            of_members = torch.cat(factors).log().view(-1, dataset.ensemble_size)
            dispersion = of_members.mean(1).exp()
        return curves, dispersion

    def _result(
        self,
        network: PolicyNetwork,
        dataset: RolloutDataset,
        training_data: TrainingData,
        curves: pd.DataFrame,
    ) -> TrainingResult:
        """Returns the networks with the situations that they have learned from."""
        head = head_class(self.settings.head).for_model(training_data.simulator.model)
        found = _training_result(network, dataset, training_data, curves, head)
        has_cold_starts = (
            training_data.pairs.base is not None and self.settings.cold_start_fraction > 0
        )
        augment = None
        if has_cold_starts:
            generator = torch.Generator().manual_seed(training_data.seed)
            time_gap = time_gaps(training_data)
            augment = Augmentation(self.settings, time_gap, generator)
        return replace(found, valid_range=learned_range(training_data, augment))

    def checkpoint(self, policy: Policy, training_data: TrainingData) -> Path | None:
        """Returns the file from which this very training goes on, or None without a workspace."""
        return checkpoint_path(self.identity(), policy, training_data)


def _training_result(
    network: PolicyNetwork,
    dataset: RolloutDataset,
    training_data: TrainingData,
    curves: pd.DataFrame,
    head: ParameterHead,
) -> TrainingResult:
    """Returns the networks; those of an ensemble as one."""
    ensemble_size = dataset.ensemble_size
    first = slice(None, None, ensemble_size)
    if ensemble_size > 1:
        network = Ensemble(network, ensemble_size).eval()
    return TrainingResult(
        network=network,
        scaler=Scaler(dataset.scaler.mean[first].clone(), dataset.scaler.scale[first].clone()),
        curves=curves,
        base=head.space.from_unit(dataset.pooled[first].to(training_data.pairs.fixed.dtype)),
        head=head.name,
    )
