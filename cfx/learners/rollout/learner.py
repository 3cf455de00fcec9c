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
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch

from cfx.agents.heads import HEADS
from cfx.agents.heads.base import ParameterHead
from cfx.agents.heads.offset import OffsetHead
from cfx.agents.scaler import Scaler
from cfx.component import Settings
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.batched import fit
from cfx.learners.rollout.augmentation import Augmentation
from cfx.learners.rollout.base_errors import BaseErrors
from cfx.learners.rollout.checkpoint import checkpoint_path
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.learners.rollout.distillation import Expert
from cfx.learners.rollout.module import RolloutModule, StepNumbers
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.situations import learned_range
from cfx.models.direct import Direct
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.ensemble import Ensemble
from cfx.progress import Task
from cfx.simulation.rollout import MemoryStepper

log = logging.getLogger(__name__)


class RolloutLearner(Learner):
    """Back-propagates the job's objective through closed-loop simulation into the policy.

    Networks answer offsets (`cfx.agents.heads.offset`): untrained, each driver is driven by their
    base parameters, so training starts from a fixed model. With `head=residual` they also choose
    how the acceleration that the model misses at first decays (`cfx.agents.heads.residual`).

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
        "epochs": 4,
        "steps": 12,
        "horizon": 10,
        "learning_rate": 0.02,
    }

    @property
    def reads_history(self) -> bool:
        return self.settings.cold_start_fraction < 1.0

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """As `Learner.fit`.

        Raises:
            ConfigError: the simulator or the model has no gradients.
        """
        simulator, s = training_data.simulator, self.settings
        self.require_gradients(simulator.model, simulator.differentiable)
        if not {"gap", "time_headway"} & set(policy.inputs):
            log.info(
                "The policy does not see the gap; policy.inputs=situation gives smaller errors"
            )
        generator = torch.Generator().manual_seed(training_data.seed)
        head = HEADS[s.head].for_model(simulator.model)
        dataset = RolloutDataset.of(
            training_data, policy, s.validation, generator, s.ensemble_size, head
        )
        network = _untrained(policy, dataset, head, generator)
        if not any(parameter.requires_grad for parameter in network.parameters()):
            curves = pd.DataFrame(columns=CURVE_COLUMNS)
            return self._result(network.eval(), dataset, training_data, curves)
        errors = BaseErrors.of(training_data, dataset, s.horizon)
        checkpoint = self.checkpoint(policy, training_data)
        expert_checkpoint = None
        if checkpoint is not None:
            expert_checkpoint = checkpoint.with_suffix(".expert.ckpt")
        expert = None
        if s.distillation_epochs:
            expert = self._expert(policy, training_data, dataset, errors, expert_checkpoint)
        module = self._trained(
            "Training", network, policy, training_data, dataset, errors, checkpoint, expert
        )
        for file in (checkpoint, expert_checkpoint):
            if file is not None:
                file.unlink(missing_ok=True)
        return self._result(module.network, dataset, training_data, module.curves())

    def _result(
        self,
        network: PolicyNetwork,
        dataset: RolloutDataset,
        training_data: TrainingData,
        curves: pd.DataFrame,
    ) -> TrainingResult:
        """Returns the networks with the situations that they have learned from."""
        head = HEADS[self.settings.head].for_model(training_data.simulator.model)
        found = _training_result(network, dataset, training_data, curves, head)
        has_cold_starts = training_data.base is not None and self.settings.cold_start_fraction > 0
        augment = None
        if has_cold_starts:
            generator = torch.Generator().manual_seed(training_data.seed)
            augment = Augmentation(self.settings, dataset.time_gap, generator)
        return replace(found, valid_range=learned_range(training_data, augment))

    def checkpoint(self, policy: Policy, training_data: TrainingData) -> Path | None:
        """Returns the file from which this very training goes on, or None without a workspace."""
        return checkpoint_path(self.identity(), policy, training_data)

    def _trained(
        self,
        title: str,
        network: PolicyNetwork,
        policy: Policy,
        training_data: TrainingData,
        dataset: RolloutDataset,
        errors: BaseErrors,
        checkpoint: Path | None,
        expert: Expert | None = None,
    ) -> RolloutModule:
        """Trains, from the checkpoint on if it is there, and leaves it behind."""
        s = self.settings
        task = Task(f"{title} ({len(dataset.pair)} networks, at most {s.epochs} epochs)", s.epochs)
        module = RolloutModule(
            network, dataset, policy, training_data, s, errors, expert, on_epoch=task.advance
        )
        fit(
            module,
            StepNumbers(s.steps),
            epochs=s.epochs,
            seed=training_data.seed,
            device=training_data.batch.lengths.device,
            task=task,
            checkpoint=checkpoint,
        )
        return module

    def _expert(
        self,
        policy: Policy,
        training_data: TrainingData,
        dataset: RolloutDataset,
        errors: BaseErrors,
        checkpoint: Path | None,
    ) -> Expert:
        """Returns experts trained on the same trajectories; from the checkpoint if it is there."""
        s, simulator = self.settings, MemoryStepper(Direct(), training_data.simulator.dt)
        space = simulator.model.adaptation_space
        fixed = training_data.fixed
        default = space.defaults(dtype=fixed.dtype, device=fixed.device)
        expert_fixed = default.expand(len(fixed), -1)
        expert_data = replace(
            training_data,
            simulator=simulator,
            fixed=expert_fixed,
            base=None if training_data.base is None else expert_fixed,
        )
        expert_dataset = dataset.for_base(space.to_unit(default).float())
        generator = torch.Generator().manual_seed(training_data.seed)
        head = OffsetHead.for_model(simulator.model)
        network = _untrained(policy, expert_dataset, head, generator)
        changes = {
            "head": head.name,
            "distillation_epochs": 0,
            "epochs": s.epochs - s.distillation_epochs,
        }
        learner = RolloutLearner(s.model_copy(update=changes))
        module = learner._trained(
            "Training experts", network, policy, expert_data, expert_dataset, errors, checkpoint
        )
        module.network.requires_grad_(False)
        return Expert(module.training_window, expert_dataset)


def _untrained(
    policy: Policy, dataset: RolloutDataset, head: ParameterHead, generator: torch.Generator
) -> PolicyNetwork:
    """Returns networks that answer no offset, on the device of the dataset."""
    device = dataset.pair.device
    default = head.space.to_unit(head.space.defaults()).float()
    start = head.untrained_answer(default.expand(len(dataset.pair), -1))
    features = dataset.scaler.mean.shape[-1]
    return policy.build(features, default, start, generator).to(device)


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
        base=head.space.from_unit(dataset.pooled[first].to(training_data.fixed.dtype)),
        head=head.name,
    )
