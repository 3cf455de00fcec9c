"""Training of a shard of networks, wherever it is.

Importing this imports Lightning, which takes seconds and 100 MB.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from cfx.core.engine import Report
from cfx.learners.batched import fit
from cfx.learners.rollout.loop import Expert
from cfx.learners.rollout.module import RolloutModule, StepNumbers
from cfx.learners.rollout.shard import (
    TrainedShard,
    TrainingShard,
    epochs,
    expert_checkpoint,
    expert_settings,
    for_experts,
    untrained,
)
from cfx.policies.heads import head_class
from cfx.policies.heads.offset import OffsetHead

log = logging.getLogger(__name__)


def train(shard: TrainingShard, report: Report) -> TrainedShard:
    """Trains the networks of a shard.

    Training goes on from the shard's checkpoint, and leaves it behind. Where there is no place for
    it, as on a worker without the job's disk, an interrupted training begins again.

    Args:
        shard: which networks, and what they learn from.
        report: called with how many epochs are done.
    """
    progress = _Epochs(report, epochs(shard.settings))
    dataset, training_data, s = shard.dataset, shard.training_data, shard.settings
    head = head_class(s.head).for_model(training_data.simulator.model)
    network = untrained(shard.policy, dataset, head)
    network.load_state_dict(shard.weights)
    if shard.checkpoint is not None and not _has_place(shard.checkpoint):
        shard = replace(shard, checkpoint=None)
    expert = None
    if s.distillation_epochs:
        expert = _expert(shard, progress.one_more)
    module = RolloutModule(
        network,
        dataset,
        shard.policy,
        training_data,
        s,
        shard.errors,
        expert,
        on_epoch=progress.one_more,
    )
    _fit(module, shard.checkpoint)
    progress.end()
    dispersion = module.fit_dispersion()
    return TrainedShard(module.network.state_dict(), module.curves(), dispersion)


def _has_place(checkpoint: Path) -> bool:
    """Says whether the folder of a checkpoint can be written to; makes it."""
    folder = checkpoint.parent
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK):
        return True
    log.warning("%s cannot be written to: if this training is interrupted, it begins again", folder)
    return False


class _Epochs:
    """Reports epochs, in the end all that were planned."""

    def __init__(self, report: Report, planned: int) -> None:
        self.report = report
        self.left = planned

    def one_more(self) -> None:
        self.left -= 1
        self.report(1)

    def end(self) -> None:
        self.report(self.left)


def _fit(module: RolloutModule, checkpoint: Path | None) -> None:
    s = module.settings
    fit(
        module,
        StepNumbers(s.steps),
        epochs=s.epochs,
        seed=module.sampler.seed,
        device=module.dataset.pair.device,
        checkpoint=checkpoint,
    )


def _expert(shard: TrainingShard, on_epoch: Callable[[], None]) -> Expert:
    """Returns experts trained on the same trajectories; from the checkpoint if it exists."""
    assert shard.expert_weights is not None
    expert_data, expert_dataset = for_experts(shard.training_data, shard.dataset)
    head = OffsetHead.for_model(expert_data.simulator.model)
    network = untrained(shard.policy, expert_dataset, head)
    network.load_state_dict(shard.expert_weights)
    module = RolloutModule(
        network,
        expert_dataset,
        shard.policy,
        expert_data,
        expert_settings(shard.settings),
        shard.errors,
        on_epoch=on_epoch,
    )
    checkpoint = None
    if shard.checkpoint is not None:
        checkpoint = expert_checkpoint(shard.checkpoint)
    _fit(module, checkpoint)
    module.network.requires_grad_(False)
    if module.scans:
        # Experts say one window at a time what they would do.
        module.training_window.compile()
    return Expert(module.training_window, expert_dataset)
