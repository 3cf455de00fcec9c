"""The Lightning module of imitation: gradient steps on segments of windows, and validation.

Shapes: N networks, B trajectories of the network that has most, S windows of a segment, f features
of a token, c features of conditioning, n tuned parameters, s width of the policy's state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from cfx.learners.batched import BatchedModule
from cfx.learners.imitation_data import ImitationDataset, ImitationSettings
from cfx.policies.base import PolicyNetwork
from cfx.policies.heads.base import ParameterHead
from cfx.simulation.kernel.compiler import torch_compiled
from cfx.simulation.rollout import can_compile

_WORTH_COMPILING = 20_000
"""Gradient steps from which compiling pays: some ten seconds of eager work."""


class SegmentData(pl.LightningDataModule):
    """Segments of consecutive windows, in order: pairs of first window and end.

    A training batch is all segments of an epoch: a gradient step is so short that Lightning's own
    work around it would be a third of it.
    """

    def __init__(self, windows: int, batch_size: int | None) -> None:
        super().__init__()
        size = batch_size or windows
        self.windows = windows
        self.segments: list[tuple[int, int]] = []
        for first in range(0, windows, size):
            self.segments.append((first, min(first + size, windows)))

    def train_dataloader(self) -> DataLoader[Any]:
        epoch: Any = [self.segments]
        return DataLoader(epoch, batch_size=None, shuffle=False)

    def val_dataloader(self) -> DataLoader[Any]:
        whole: Any = [(0, self.windows)]
        return DataLoader(whole, batch_size=None)


class ImitationModule(BatchedModule):
    """Trains N networks on their segments, a gradient step for each."""

    fused = True

    def __init__(
        self,
        network: PolicyNetwork,
        dataset: ImitationDataset,
        head: ParameterHead,
        settings: ImitationSettings,
        names: tuple[str, ...],
        on_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(network, names, settings, on_epoch)
        self.automatic_optimization = False
        self.dataset = dataset
        self.head = head
        self.train_loss = torch.zeros(len(names))
        if _is_worth_compiling(settings, dataset):
            # The compiled function takes the method's place.
            self.segment_error = torch_compiled(self.segment_error, dynamic=False)  # type: ignore[method-assign]

    def training_step(self, segments: list[tuple[int, int]], index: int) -> None:
        dataset, optimizer = self.dataset, self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        networks, drivers = dataset.features.shape[:2]
        state = self.network.initial_state(networks, drivers)
        base = dataset.base[:, :, None]
        errors, weights = torch.zeros_like(self.train_loss), torch.zeros_like(self.train_loss)
        errors, weights = errors.to(base.device), weights.to(base.device)
        for first, last in segments:
            windows = slice(first, last)
            weight = dataset.train_weight[:, :, windows]
            error, after = self.segment_error(
                dataset.features[:, :, windows], dataset.labels[:, :, windows], weight, base, state
            )
            total = weight.sum((1, 2))
            optimizer.zero_grad()
            torch.autograd.backward((error / total.clamp(min=1e-9)).sum())
            self.configure_gradient_clipping(optimizer)
            optimizer.step()
            state = after.detach()
            errors += error.detach()
            weights += total
        self.train_loss = (errors / weights.clamp(min=1e-9)).cpu()

    def validation_step(self, segment: tuple[int, int], index: int) -> None:
        dataset = self.dataset
        networks, drivers = dataset.features.shape[:2]
        state = self.network.initial_state(networks, drivers)
        answer, _ = self.network(dataset.features, state)
        weight = dataset.validation_weight
        total = weight.sum((1, 2))
        error = self._weighted_error(answer, dataset.labels, weight, dataset.base[:, :, None])
        validation = torch.where(total > 0, error / total.clamp(min=1e-9), math.nan)
        self.judge(self.train_loss, validation.cpu())

    def segment_error(
        self, features: Tensor, labels: Tensor, weight: Tensor, base: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Lets the networks answer S consecutive windows.

        Args:
            features: `(N, B, S, f + c)`.
            labels: in unit space, `(N, B, S, n)`.
            weight: `(N, B, S)`.
            base: in unit space, `(N, B, 1, n)`.
            state: of the networks before, `(N, B, s)`.

        Returns:
            Each network's weighted sum of squared errors, `(N,)`, and the state afterwards.
        """
        answer, after = self.network(features, state)
        return self._weighted_error(answer, labels, weight, base), after

    def _weighted_error(
        self, answer: Tensor, labels: Tensor, weight: Tensor, base: Tensor
    ) -> Tensor:
        """Returns each network's weighted sum of squared errors, `(N,)`; mean over parameters."""
        unit = self.head.unit_parameters(answer, base)
        return ((unit - labels).square().mean(-1) * weight).sum((1, 2))


def _is_worth_compiling(settings: ImitationSettings, dataset: ImitationDataset) -> bool:
    if settings.compile == "never" or not can_compile(dataset.base.device):
        return False
    steps = settings.epochs * -(-dataset.windows // (settings.batch_size or dataset.windows))
    return settings.compile == "always" or steps >= _WORTH_COMPILING
