"""A head: what a network's answer means. This one keeps parameters near each driver's own.

A learner asks it for `untrained_answer` once; `unit_parameters` follows the network in every window
of training and of driving. It answers how far from the driver's parameters, in unit space.

Shapes: `*batch` any leading dimensions, N networks, n tuned parameters.
"""

from __future__ import annotations

from typing import ClassVar, Self

import torch
from cfx.plugin import DrivingModel, ParameterHead
from torch import Tensor

LARGEST_STEP = 0.1
"""Farthest that a parameter moves, as a share of the distance between its bounds."""


class Nearby(ParameterHead):
    """Moves each driver's base parameters by at most a tenth of the distance between the bounds.

    p = clamp(base + LARGEST_STEP * (2 answer - 1), 0, 1), in unit space.
    """

    name: ClassVar[str] = "nearby"
    learners: ClassVar[tuple[str, ...]] = ("imitation", "rollout")
    needs_base: ClassVar[bool] = True

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(model.space, device)

    @property
    def width(self) -> int:
        return len(self.space)

    def condition(self, base: Tensor) -> Tensor:
        return base

    def untrained_answer(self, fixed: Tensor) -> Tensor:
        return torch.full_like(fixed, 0.5)  # an untrained network leaves the base as it is

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        if base is None:
            raise ValueError("this head needs each driver's base parameters")
        step = LARGEST_STEP * (2.0 * answer - 1.0)
        return (base.to(answer.dtype) + step).clamp(0.0, 1.0)
