"""The offset head: answers are offsets from base parameters.

A network that answers offsets starts, for each driver, from parameters that already fit them: the
driver-specific set, or the pooled one. Its answer in unit space, where 1/2 means no offset, is
added to the base in the squashed space (on logits). So an untrained network *is* the base, and no
answer leaves the bounds.

Shapes: `*batch` any leading dimensions, n tuned parameters.
"""

from __future__ import annotations

from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import ParameterSpace, squashed
from cfx.models.base import DrivingModel
from cfx.policies.heads.base import ParameterHead

NONE = 0.5
"""The answer that leaves the base as it is."""

_SMALLEST = 1e-6
"""Answers within this of 0 or 1 count as being that far away, so that their logits are finite."""

_GAIN = 3.0
"""Factor on an answer's logit. Networks begin with small outputs, and models with parameters far
from the middle of their bounds (Wiedemann 99) need large offsets: without the factor they train
three times as long to reach them."""


class OffsetHead(ParameterHead):
    """Answers are offsets from each driver's base, within the model's adaptation bounds."""

    name: ClassVar[str] = "offset"
    learners: ClassVar[tuple[str, ...]] = ("imitation", "rollout")
    needs_base: ClassVar[bool] = True

    def __init__(self, space: ParameterSpace, device: torch.device | str | None = None) -> None:
        super().__init__(space, device)
        self.adaptable = space.adaptable(device=device)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(model.adaptation_space, device)

    @property
    def width(self) -> int:
        return len(self.space)

    def condition(self, base: Tensor) -> Tensor:
        return squashed(base)

    def untrained_answer(self, fixed: Tensor) -> Tensor:
        return torch.full_like(fixed, NONE)

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        if base is None:
            raise ValueError("the offset head needs each driver's base parameters")
        return moved(base, answer, self.adaptable)


def shrunk(space: ParameterSpace, parameters: Tensor, shrinkage: float) -> Tensor:
    """Shrinks driver-specific parameters towards the model's default in the squashed space.

    Ten parameters fitted to one minute of driving hold much that is chance. As a starting point for
    offsets they do better when they are shrunk towards what is known beforehand, as estimates of
    many small groups do (W. James and C. Stein, 1961, *Estimation with quadratic loss*, Proc. 4th
    Berkeley Symposium).

    Args:
        space: the model's parameters.
        parameters: `(*batch, n)`, SI units.
        shrinkage: 0: exactly the given parameters; 1: the default.

    Returns:
        `(*batch, n)`, SI units.
    """
    if shrinkage == 0:
        return parameters
    default = space.defaults(dtype=parameters.dtype, device=parameters.device)
    calibrated = squashed(space.to_unit(parameters))
    target = squashed(space.to_unit(default.expand_as(parameters)))
    return space.from_unit(torch.sigmoid(torch.lerp(calibrated, target, shrinkage)))


def blended(base: Tensor, unit: Tensor, weight: Tensor) -> Tensor:
    """Returns parameters between two sets, mixed in the squashed space.

    Args:
        base: `(*batch, n)` in unit space; exactly this where the weight is 0.
        unit: `(*batch, n)` in unit space.
        weight: of the second, 0 to 1, broadcasting to `(*batch, n)`.

    Returns:
        `(*batch, n)` in unit space.
    """
    mixed = torch.sigmoid(torch.lerp(squashed(base), squashed(unit), weight))
    return torch.where(weight > 0, mixed, base)


def moved(base: Tensor, answer: Tensor, adaptable: Tensor | None = None) -> Tensor:
    """Returns the base moved by an answer; exactly the base where the answer is 1/2.

    A base within 0.5 % of a bound is moved as if it were that far from it, and the difference is
    kept.

    Args:
        base: where offsets start, `(*batch, n)` in unit space.
        answer: of a network, `(*batch, n)` in [0, 1].
        adaptable: which parameters may be moved, bool `(n,)`; None: all.

    Returns:
        `(*batch, n)` in unit space.
    """
    if adaptable is not None:
        answer = torch.where(adaptable, answer, NONE)
    offset = _GAIN * torch.logit(answer, eps=_SMALLEST)
    return (base + step_of(base, offset)).clamp(0.0, 1.0)


def step_of(base: Tensor, offset: Tensor) -> Tensor:
    """Returns how far an offset on logits moves a base; exactly 0 where the offset is 0.

    Args:
        base: `(*batch, n)` in unit space; within 0.5 % of a bound it counts as that far from it.
        offset: on logits, `(*batch, n)`.

    Returns:
        `(*batch, n)` in unit space.
    """
    logit = squashed(base)
    return torch.sigmoid(logit + offset) - torch.sigmoid(logit)
