"""Training data of imitation: its settings, and labels with their windows.

Shapes: P pairs, N networks, B trajectories of the network that has most, W windows, f features of a
token, c features of conditioning, n tuned parameters.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import torch
from pydantic import AfterValidator, Field
from torch import Tensor, nn

from cfx.core.component import Settings
from cfx.core.errors import DataError
from cfx.learners.base import TrainingData
from cfx.policies.base import Policy
from cfx.policies.features import Scaler, measured_history, tokens
from cfx.policies.heads import trained_head
from cfx.policies.heads.base import ParameterHead
from cfx.policies.placement import Grid
from cfx.simulation.rollout import Compile


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


class _Rows(NamedTuple):
    """The R trajectories that networks learn from: one for each pair and base.

    Attributes:
        pair: `(R,)`.
        network: `(R,)`.
        base: in unit space, `(R, n)`, single precision.
    """

    pair: Tensor
    network: Tensor
    base: Tensor


def _rows(training_data: TrainingData, head: ParameterHead) -> _Rows:
    """Returns each pair with its base, and with the pooled one where that is another."""
    device = training_data.device
    pair = torch.arange(len(training_data.pairs), device=device)
    network = training_data.pairs.network.to(device)
    pooled, own = training_data.pairs.fixed, training_data.pairs.base
    unit_pooled = head.space.to_unit(pooled).float()
    if own is None or not head.needs_base or torch.equal(own, pooled):
        return _Rows(pair, network, unit_pooled)
    unit_own = head.space.to_unit(own).float()
    return _Rows(pair.repeat(2), network.repeat(2), torch.cat([unit_own, unit_pooled]))


class ImitationDataset(nn.Module):
    """Training tensors as N networks by B trajectories by W windows.

    They are buffers, so that Lightning moves them with the module.

    Attributes:
        features: token and conditioning, normalised, `(N, B, W, f + c)`.
        labels: in the head's unit space, `(N, B, W, n)`.
        base: in unit space, `(N, B, n)`.
        train_weight, validation_weight: `(N, B, W)`.
    """

    features: Tensor
    labels: Tensor
    base: Tensor
    train_weight: Tensor
    validation_weight: Tensor

    def __init__(
        self,
        scaler: Scaler,
        features: Tensor,
        labels: Tensor,
        base: Tensor,
        train_weight: Tensor,
        validation_weight: Tensor,
    ) -> None:
        super().__init__()
        self.scaler = scaler
        self.register_buffer("features", features)
        self.register_buffer("labels", labels)
        self.register_buffer("base", base)
        self.register_buffer("train_weight", train_weight)
        self.register_buffer("validation_weight", validation_weight)

    @property
    def windows(self) -> int:
        return self.features.shape[2]

    @classmethod
    def of(
        cls,
        policy: Policy,
        training_data: TrainingData,
        settings: ImitationSettings,
        head: ParameterHead,
    ) -> ImitationDataset:
        """Places training data.

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
        seen = tokens(history, policy.inputs, policy.summary).float()
        unit = head.space.to_unit(labels.parameters).float()
        tokens_of_pairs, mask = windows.to_grid(seen, pairs)
        labels_of_pairs, _ = windows.to_grid(unit, pairs)
        sensitivity, _ = windows.to_grid(labels.sensitivity.float(), pairs)
        train = _training_windows(mask, settings.validation)
        weight = torch.ones_like(sensitivity)
        if settings.weight_by_sensitivity:
            weight = _sensitivity_weight(sensitivity, train)
        rows = _rows(training_data, head)
        grid = Grid(rows.network, len(training_data.names))
        conditioning = head.condition(rows.base)[:, None].expand(-1, mask.shape[1], -1)
        features = grid.scatter(torch.cat([tokens_of_pairs[rows.pair], conditioning], -1))
        scaler = Scaler.of(features, grid.scatter(train[rows.pair]))
        return cls(
            scaler=scaler,
            features=scaler(features),
            labels=grid.scatter(labels_of_pairs[rows.pair]),
            base=grid.scatter(rows.base),
            train_weight=grid.scatter((weight * train)[rows.pair]),
            validation_weight=grid.scatter((weight * (mask & ~train))[rows.pair]),
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
    kept = (counts * validation).round().long()
    if validation > 0:
        kept = kept.clamp(min=1)
    if bool((counts - kept < 1).any()):
        raise DataError(
            f"a pair has only {int(counts.min())} training windows, too few to keep {validation:g}"
            " of them for validation; raise data.min_frames or set learner.validation=0"
        )
    number = torch.arange(mask.shape[1], device=mask.device)
    return mask & (number < (counts - kept)[:, None])


def _sensitivity_weight(sensitivity: Tensor, train: Tensor) -> Tensor:
    """Returns weights `(P, W)` in proportion to the sensitivity of each window's loss.

    Their mean is 1 over each pair's training windows; they are ones if all sensitivities are 0.
    """
    count = train.sum(1, keepdim=True)
    mean = (sensitivity * train).sum(1, keepdim=True) / count
    tiny = torch.finfo(sensitivity.dtype).tiny
    return torch.where(mean > 0, sensitivity / mean.clamp(min=tiny), 1.0)
