"""Imitation of per-window calibrated parameters (labels): the paper's way to train a policy.

The policy reads the measured trajectory window by window and learns to answer the parameters that
calibration found for each. All networks are trained at once as one batched network; the sum of
their losses trains each as if it were alone.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import pandas as pd
import torch
from pydantic import AfterValidator, Field

from cfx.core.component import Settings
from cfx.core.progress import Task
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult, learned_range
from cfx.learners.curves import warn_of_nothing_learned
from cfx.policies.base import Policy
from cfx.policies.core import Grid
from cfx.policies.heads import head_class, trained_head
from cfx.simulation.rollout import Compile, can_compile

log = logging.getLogger(__name__)

_WORTH_COMPILING = 20_000
"""Gradient steps from which compiling pays: some ten seconds of eager work."""


class ImitationSettings(Settings):
    """Settings of `imitation`."""

    head: Annotated[str, AfterValidator(trained_head("imitation"))] = Field(
        "direct",
        description="what networks answer: direct: the parameters themselves (paper); offset:"
        " offsets from each driver's base parameters",
    )
    epochs: int = Field(
        200, ge=1, description="passes over the training windows at most; 500 in the paper"
    )
    batch_size: int | None = Field(
        16,
        ge=1,
        description="consecutive windows per gradient step, the recurrent state carried on; null:"
        " the whole trajectory; 1 in the paper",
    )
    learning_rate: float = Field(3e-3, gt=0, le=1, description="of Adam")
    weight_decay: float = Field(0.0, ge=0, le=10, description="of AdamW, decoupled")
    validation: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="share of the training windows, the last ones, kept for validation",
    )
    patience: int | None = Field(
        30,
        ge=1,
        description="epochs without a better validation loss after which a network stops; null:"
        " never",
    )
    weight_by_sensitivity: bool = Field(
        True,
        description="weight each window by how much its loss depends on the parameters; false in"
        " the paper",
    )
    gradient_clip: float | None = Field(
        1.0, gt=0, description="largest gradient norm of a network; null: none"
    )
    compile: Compile = Field(
        "auto", description="a gradient step's loss: auto: where it pays; always; never"
    )


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
        # Lightning takes seconds to import, and 100 MB: only where something is trained.
        from cfx.learners.batched import fit
        from cfx.learners.imitation_module import ImitationDataset, ImitationModule

        s, device = self.settings, training_data.device
        head = head_class(s.head).for_model(training_data.stepper.model, device)
        space, names, started = head.space, training_data.names, training_data.pairs.start
        weighs = s.weight_by_sensitivity
        dataset = ImitationDataset.of(policy, training_data, head, s.validation, weighs=weighs)
        generator = torch.Generator().manual_seed(training_data.seed)
        default = space.to_unit(space.defaults()).float()
        grid = Grid(training_data.pairs.network.to(device), len(names))
        pooled = grid.mean(space.to_unit(started)).float()
        start = head.untrained_answer(pooled.cpu())
        network = policy.build(dataset.features.shape[-1], default, start, generator)
        curves = pd.DataFrame(columns=CURVE_COLUMNS)
        if any(parameter.requires_grad for parameter in network.parameters()):
            log.info(
                "learner=imitation, the paper's method, reproduces labels; trained through"
                " simulation (learner=rollout) policies follow real drivers more closely"
            )
            task = Task(f"Training ({len(names)} networks, at most {s.epochs} epochs)", s.epochs)
            module = ImitationModule(network, names, s, dataset, head, s.batch_size, task.advance)
            if self._is_worth_compiling(dataset.windows, device):
                module.compile_step()
            with task:
                fit(module, training_data.seed, device, None)
            curves = module.curves()
            warn_of_nothing_learned(curves)
        base = None
        if head.needs_base:
            base = space.from_unit(pooled.to(started.dtype))
        return TrainingResult(
            network=network.eval(),
            scaler=dataset.scaler,
            curves=curves,
            base=base,
            head=head.name,
            valid_range=learned_range(training_data),
        )

    def _is_worth_compiling(self, windows: int, device: torch.device) -> bool:
        s = self.settings
        if s.compile == "never" or not can_compile(device):
            return False
        steps = s.epochs * -(-windows // (s.batch_size or windows))
        return s.compile == "always" or steps >= _WORTH_COMPILING
