"""Training of imitation: its data on networks, gradient steps on segments of windows, validation.

Importing this imports Lightning, which takes seconds and 100 MB.

Shapes: P pairs, N networks, B trajectories of the network that has most, W windows, S windows of a
segment, f features of a token, c features of conditioning, n tuned parameters, s width of the
policy's state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from cfx.errors import DataError
from cfx.learners.base import TrainingData
from cfx.learners.batched import BatchedModule, Training
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.core import Grid
from cfx.policies.features import Scaler, tokens
from cfx.policies.heads.base import ParameterHead
from cfx.policies.history import measured_history
from cfx.policies.inputs import policy_inputs
from cfx.simulation.kernel.compiler import torch_compiled


class ImitationDataset(NamedTuple):
    """Training tensors as N networks by B trajectories by W windows.

    Attributes:
        scaler: normalises features.
        features: token and conditioning, normalised, `(N, B, W, f + c)`.
        labels: in the head's unit space, `(N, B, W, n)`.
        base: in unit space, `(N, B, n)`.
        train_weight, validation_weight: `(N, B, W)`.
    """

    scaler: Scaler
    features: Tensor
    labels: Tensor
    base: Tensor
    train_weight: Tensor
    validation_weight: Tensor

    @property
    def windows(self) -> int:
        """W."""
        return self.features.shape[2]

    @classmethod
    def of(
        cls,
        policy: Policy,
        training_data: TrainingData,
        head: ParameterHead,
        validation: float,
        *,
        weighs: bool,
    ) -> ImitationDataset:
        """Places training data.

        Args:
            policy: says what networks read.
            training_data: with labels.
            head: makes parameters of answers.
            validation: share of each pair's windows, the last ones, that is kept for validation.
            weighs: whether windows weigh by the sensitivity of their loss.

        Raises:
            DataError: a pair has too few windows to keep some for validation.
        """
        labels, pairs = training_data.pairs.labels, len(training_data.pairs)
        if labels is None:
            raise TypeError("imitation needs labels: the parameters calibrated for each window")
        windows, device = labels.windows, training_data.device
        pair, first = windows.pair.to(device), windows.first.to(device)
        recorded = training_data.pairs.index.to(device)[pair]
        length = training_data.windows.length
        history = measured_history(training_data.recorded, recorded, first, length)
        tokens_of_windows = tokens(history, policy_inputs(policy.inputs), policy.summary).float()
        unit = head.space.to_unit(labels.parameters).float()
        tokens_of_pairs, mask = windows.to_grid(tokens_of_windows, pairs)
        labels_of_pairs, _ = windows.to_grid(unit, pairs)
        sensitivity, _ = windows.to_grid(labels.sensitivity.float(), pairs)
        train = _training_windows(mask, validation)
        weight = torch.ones_like(sensitivity)
        if weighs:
            weight = _sensitivity_weight(sensitivity, train)
        # Each pair is learned from with its base, and with the pooled one where that is another.
        rows, network = torch.arange(pairs, device=device), training_data.pairs.network.to(device)
        pooled, driver_specific = training_data.pairs.start, training_data.pairs.base
        base = head.space.to_unit(pooled).float()
        has_both = driver_specific is not None and not torch.equal(driver_specific, pooled)
        if driver_specific is not None and has_both and head.needs_base:
            rows, network = rows.repeat(2), network.repeat(2)
            base = torch.cat([head.space.to_unit(driver_specific).float(), base])
        grid = Grid(network, len(training_data.names))
        conditioning = head.condition(base)[:, None].expand(-1, mask.shape[1], -1)
        features = grid.scatter(torch.cat([tokens_of_pairs[rows], conditioning], -1))
        scaler = Scaler.of(features, grid.scatter(train[rows]))
        return cls(
            scaler=scaler,
            features=scaler(features),
            labels=grid.scatter(labels_of_pairs[rows]),
            base=grid.scatter(base),
            train_weight=grid.scatter((weight * train)[rows]),
            validation_weight=grid.scatter((weight * (mask & ~train))[rows]),
        )


def _training_windows(mask: Tensor, validation: float) -> Tensor:
    """Returns the windows that are trained on: all but each pair's last ones, bool `(P, W)`.

    Args:
        mask: windows that there are, bool `(P, W)`.
        validation: share that is kept for validation; above 0 at least one window is.

    Raises:
        DataError: nothing is left of a pair.
    """
    counts = mask.sum(1)
    held_out = (counts * validation).round().long()
    if validation > 0:
        held_out = held_out.clamp(min=1)
    if bool((counts - held_out < 1).any()):
        raise DataError(
            f"a pair has only {int(counts.min())} training windows, too few to keep {validation:g}"
            " of them for validation; raise data.min_duration or set learner.validation=0"
        )
    number = torch.arange(mask.shape[1], device=mask.device)
    return mask & (number < (counts - held_out)[:, None])


def _sensitivity_weight(sensitivity: Tensor, train: Tensor) -> Tensor:
    """Returns weights `(P, W)` in proportion to the sensitivity of each window's loss.

    Their mean is 1 over each pair's training windows; they are ones if all sensitivities are 0.
    """
    count = train.sum(1, keepdim=True)
    mean = (sensitivity * train).sum(1, keepdim=True) / count
    tiny = torch.finfo(sensitivity.dtype).tiny
    return torch.where(mean > 0, sensitivity / mean.clamp(min=tiny), 1.0)


class ImitationModule(BatchedModule):
    """Trains N networks on segments of consecutive windows, a gradient step for each segment.

    A training batch is all segments of an epoch: a gradient step is so short that Lightning's own
    work around it would be a third of it.
    """

    fused = True

    def __init__(
        self,
        network: PolicyNetwork,
        names: tuple[str, ...],
        settings: Training,
        dataset: ImitationDataset,
        head: ParameterHead,
        batch_size: int | None,
        on_epoch: Callable[[], None],
    ) -> None:
        super().__init__(network, names, settings, on_epoch)
        self.dataset, self.head = dataset, head
        size = batch_size or dataset.windows
        self.segments = []
        for first in range(0, dataset.windows, size):
            self.segments.append((first, min(first + size, dataset.windows)))

    def train_dataloader(self) -> DataLoader[Any]:
        epoch: Any = [self.segments]
        return DataLoader(epoch, batch_size=None, generator=self.loaders_generator)

    def compile_step(self) -> None:
        """Compiles the error of a segment; the compiled function takes the method's place."""
        self.segment_error = torch_compiled(self.segment_error, dynamic=False)  # type: ignore[method-assign]

    def training_step(self, segments: list[tuple[int, int]], index: int) -> None:
        dataset, optimizer = self.dataset, self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        networks, drivers = dataset.features.shape[:2]
        state = self.network.initial_state(networks, drivers)
        base = dataset.base[:, :, None]
        errors, weights = base.new_zeros(networks), base.new_zeros(networks)
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

    def validation_step(self, number: int, index: int) -> None:
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
