"""Imitation of per-window calibrated parameters (labels): the paper's way to train a policy.

The policy reads the measured trajectory window by window and learns to answer the parameters that
calibration found for each. All networks are trained at once as one batched network; the sum of
their losses trains each as if it were alone.

Shapes: P pairs, N networks, B trajectories of the network that has most, W windows, f features of a
token, c features of conditioning, n tuned parameters.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import pandas as pd
import torch

from cfx.core.component import Settings
from cfx.core.progress import Task
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.curves import warn_of_nothing_learned
from cfx.learners.imitation_data import ImitationDataset, ImitationSettings
from cfx.learners.situations import learned_range
from cfx.policies.base import Policy
from cfx.policies.heads import head_class
from cfx.policies.placement import Grid

log = logging.getLogger(__name__)


class ImitationLearner(Learner):
    """Learns labels by mean squared error in unit space.

    With `head=offset` the error is that of the parameters that an offset means. Each trajectory is
    then learned from with the driver's own base and, where unseen drivers start from the pooled
    parameters, with these as well.

    Differences from the paper: windows can be weighted by the sensitivity of their loss, because
    the labels of windows that do not determine the parameters are arbitrary
    (`weight_by_sensitivity=false` gives the paper's plain error); the weights of the epoch with the
    smallest validation loss are kept, for each network on its own; answers can be offsets.
    """

    schema: ClassVar[type[Settings]] = ImitationSettings
    settings: ImitationSettings
    trial: ClassVar[Mapping[str, Any]] = {"epochs": 30, "learning_rate": 0.03}
    needs_labels = True

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """As `Learner.fit`.

        Raises:
            ConfigError: the policy reads driver features.
            DataError: a pair has too few windows to keep some for validation.
        """
        self.require_no_driver_features(policy)
        s, device = self.settings, training_data.device
        head = head_class(s.head).for_model(training_data.simulator.model, device)
        space, names = head.space, training_data.names
        dataset = ImitationDataset.of(policy, training_data, s, head)
        generator = torch.Generator().manual_seed(training_data.seed)
        default = space.to_unit(space.defaults()).float()
        grid = Grid(training_data.pairs.network.to(device), len(names))
        fixed = grid.mean(space.to_unit(training_data.pairs.fixed)).float()
        start = head.untrained_answer(fixed.cpu())
        network = policy.build(dataset.features.shape[-1], default, start, generator)
        base = None
        if head.needs_base:
            base = space.from_unit(fixed.to(training_data.pairs.fixed.dtype))
        if not any(parameter.requires_grad for parameter in network.parameters()):
            curves = pd.DataFrame(columns=CURVE_COLUMNS)
            found = learned_range(training_data)
            scaler = dataset.scaler
            return TrainingResult(network.eval(), scaler, curves, base, head.name, found)
        log.info(
            "learner=imitation, the paper's method, reproduces labels; trained through simulation"
            " (learner=rollout) policies follow real drivers more closely"
        )
        # Lightning takes seconds to import, and 100 MB: only where something is trained.
        from cfx.learners.batched import fit
        from cfx.learners.imitation_module import ImitationModule, SegmentData

        task = Task(f"Training ({len(names)} networks, at most {s.epochs} epochs)", s.epochs)
        module = ImitationModule(network, dataset, head, s, names, on_epoch=task.advance)
        with task:
            fit(
                module,
                SegmentData(dataset.windows, s.batch_size),
                epochs=s.epochs,
                seed=training_data.seed,
                device=device,
            )
        scaler, curves = dataset.scaler.to(device), module.curves()
        warn_of_nothing_learned(curves)
        found = learned_range(training_data)
        return TrainingResult(module.network, scaler, curves, base, head.name, found)
