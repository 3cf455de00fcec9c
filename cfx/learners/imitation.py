"""Imitation of window labels: the paper's way to train a policy.

The policy reads the measured drive window by window and learns to answer the parameters that calibration found for each. All
networks are trained at once as one batched network; the sum of their losses trains each as if it were alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import lightning.pytorch as pl
import pandas as pd
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.utils.data import DataLoader

from cfx.agents.scaler import Scaler
from cfx.component import Settings
from cfx.errors import DataError
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.batched import BatchedModule, Grid, fit
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import measured_history, token_width, tokens
from cfx.progress import Task


class ImitationSettings(Settings):
    """Settings of `imitation`."""

    epochs: int = Field(
        200, ge=1, description="passes over the training windows at most; 500 in the paper"
    )
    batch_size: int | None = Field(
        16,
        ge=1,
        description="consecutive windows per gradient step, the recurrent state carried on; null: the whole drive; 1 in the"
        " paper",
    )
    learning_rate: float = Field(3e-3, gt=0, description="of Adam")
    weight_decay: float = Field(0.0, ge=0, description="of AdamW, decoupled")
    validation: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="share of the training windows, the last ones, kept for validation",
    )
    patience: int | None = Field(
        30,
        ge=1,
        description="epochs without a better validation loss after which a network stops; null: never",
    )
    weight_by_sensitivity: bool = Field(
        True,
        description="weight each window by how much the choice of parameters matters in it; false in the paper",
    )
    gradient_clip: float | None = Field(
        1.0, gt=0, description="largest gradient norm of a network; null: none"
    )


class ImitationLearner(Learner):
    """Learns window labels by mean squared error in unit space.

    Differences from the paper: windows can be weighted by their loss spread, because the labels of windows that do not
    determine the parameters are arbitrary (`weight_by_sensitivity=false` gives the paper's plain error); the weights of the epoch
    with the smallest validation loss are kept, for each network on its own.
    """

    schema: ClassVar[type[Settings]] = ImitationSettings
    settings: ImitationSettings
    needs_labels = True

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        if training_data.labels is None:
            raise TypeError("imitation needs window labels")
        self.require_no_driver_features(policy)
        dataset = _ImitationDataset.of(policy, training_data, self.settings)
        generator = torch.Generator().manual_seed(training_data.seed)
        space = training_data.simulator.model.space
        unit_default = space.to_unit(space.defaults()).float()
        grid = Grid(training_data.network.to(training_data.fixed.device), len(training_data.names))
        unit_fixed = grid.mean(space.to_unit(training_data.fixed)).float()
        network = policy.build(dataset.tokens.shape[-1], unit_default, unit_fixed.cpu(), generator)
        if not any(parameter.requires_grad for parameter in network.parameters()):
            return TrainingResult(
                network.eval(), dataset.scaler, pd.DataFrame(columns=CURVE_COLUMNS)
            )
        task = Task(
            f"Training ({len(training_data.names)} networks, at most {self.settings.epochs} epochs)",
            self.settings.epochs,
        )
        module = ImitationModule(
            network, dataset, self.settings, training_data.names, on_epoch=task.advance
        )
        data = SegmentData(dataset.windows, self.settings.batch_size)
        device = dataset.tokens.device
        fit(
            module,
            data,
            epochs=self.settings.epochs,
            seed=training_data.seed,
            device=device,
            task=task,
        )
        return TrainingResult(module.network, dataset.scaler.to(device), module.curves())


class _ImitationDataset(nn.Module):
    """Training tensors as N networks by B drivers by W windows; buffers, so that Lightning moves them with the module."""

    tokens: Tensor
    labels: Tensor
    train_weight: Tensor
    validation_weight: Tensor

    def __init__(
        self,
        scaler: Scaler,
        tokens: Tensor,
        labels: Tensor,
        train_weight: Tensor,
        validation_weight: Tensor,
    ) -> None:
        super().__init__()
        self.scaler = scaler
        self.register_buffer("tokens", tokens)
        self.register_buffer("labels", labels)
        self.register_buffer("train_weight", train_weight)
        self.register_buffer("validation_weight", validation_weight)

    @property
    def windows(self) -> int:
        return self.tokens.shape[2]

    @classmethod
    def of(
        cls, policy: Policy, training_data: TrainingData, settings: ImitationSettings
    ) -> _ImitationDataset:
        assert training_data.labels is not None
        labels, batch = training_data.labels, training_data.batch
        device = batch.lengths.device
        pairs = len(batch)
        where = labels.windows
        history = measured_history(
            batch, where.pair.to(device), where.first.to(device), training_data.windows.length
        )
        seen = tokens(history, policy.inputs, policy.summary).float()
        assert seen.shape[-1] == token_width(
            policy.inputs, policy.summary, training_data.windows.length
        )
        unit = training_data.simulator.model.space.to_unit(labels.parameters).float()
        token_grid, mask = where.to_grid(seen, pairs)
        label_grid, _ = where.to_grid(unit, pairs)
        sensitivity_grid, _ = where.to_grid(labels.sensitivity.float(), pairs)
        number = torch.arange(mask.shape[1], device=device)
        counts = mask.sum(1)
        kept = (counts * settings.validation).round().long()
        if settings.validation > 0:
            kept = kept.clamp(min=1)
        if bool((counts - kept < 1).any()):
            raise DataError(
                f"a pair has only {int(counts.min())} training windows, too few to keep {settings.validation:g} of them for"
                f" validation;"
                " raise data.min_frames or set learner.validation=0"
            )
        train = mask & (number < (counts - kept)[:, None])
        validation = mask & ~train
        weight = (
            _sensitivity_weight(sensitivity_grid, train)
            if settings.weight_by_sensitivity
            else torch.ones_like(sensitivity_grid)
        )
        grid = Grid(training_data.network.to(device), len(training_data.names))
        train_grid = grid.scatter(train)
        scaler = Scaler.of(grid.scatter(token_grid), train_grid)
        return cls(
            scaler,
            scaler(grid.scatter(token_grid)),
            grid.scatter(label_grid),
            grid.scatter(weight * train),
            grid.scatter(weight * validation),
        )


def _sensitivity_weight(sensitivity: Tensor, train: Tensor) -> Tensor:
    """Returns weights `(P, W)` in proportion to the loss spread.

    Their mean is 1 over each pair's training windows; they are ones if all spreads are 0.
    """
    count = train.sum(1, keepdim=True)
    mean = (sensitivity * train).sum(1, keepdim=True) / count
    return torch.where(
        mean > 0, sensitivity / mean.clamp(min=torch.finfo(sensitivity.dtype).tiny), 1.0
    )


class SegmentData(pl.LightningDataModule):
    """Segments of consecutive windows, in order: a batch is (first window, last window, whether the drive begins)."""

    def __init__(self, windows: int, batch_size: int | None) -> None:
        super().__init__()
        size = batch_size or windows
        self.segments = [(first, min(first + size, windows)) for first in range(0, windows, size)]
        self.windows = windows

    def train_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.segments, batch_size=None, shuffle=False)  # type: ignore[arg-type]  # a list is a dataset

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader([(0, self.windows)], batch_size=None)  # type: ignore[arg-type]  # a list is a dataset


class ImitationModule(BatchedModule):
    """Trains N networks on their segments."""

    def __init__(
        self,
        network: PolicyNetwork,
        dataset: _ImitationDataset,
        settings: ImitationSettings,
        names: tuple[str, ...],
        on_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(network, names, settings, on_epoch)
        self.dataset = dataset
        self.state: Tensor | None = None
        self.train_sum = torch.zeros(len(names))
        self.train_weight = torch.zeros(len(names))

    def training_step(self, segment: tuple[int, int], index: int) -> Tensor:
        first, last = segment
        networks, drivers = self.dataset.tokens.shape[:2]
        if first == 0 or self.state is None:
            self.state = self.network.initial_state(networks, drivers)
        out, state = self.network(self.dataset.tokens[:, :, first:last], self.state)
        self.state = state.detach()
        weight = self.dataset.train_weight[:, :, first:last]
        error = _weighted_error(out, self.dataset.labels[:, :, first:last], weight)
        total = weight.sum((1, 2))
        self.train_sum += error.detach().cpu()
        self.train_weight += total.detach().cpu()
        return (error / total.clamp(min=1e-9)).sum()

    def validation_step(self, segment: tuple[int, int], index: int) -> None:
        networks, drivers = self.dataset.tokens.shape[:2]
        out, _ = self.network(self.dataset.tokens, self.network.initial_state(networks, drivers))
        weight = self.dataset.validation_weight
        total = weight.sum((1, 2))
        loss = _weighted_error(out, self.dataset.labels, weight) / total.clamp(min=1e-9)
        self.judge(
            self.train_sum / self.train_weight.clamp(min=1e-9),
            torch.where(total > 0, loss, math.nan).cpu(),
        )
        self.train_sum.zero_()
        self.train_weight.zero_()


def _weighted_error(out: Tensor, labels: Tensor, weight: Tensor) -> Tensor:
    """Returns the weighted sum of squared errors of each network, `(N,)`; the mean over parameters."""
    return ((out - labels).square().mean(-1) * weight).sum((1, 2))
