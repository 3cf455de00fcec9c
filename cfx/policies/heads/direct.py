"""The direct head: answers are the parameters themselves."""

from __future__ import annotations

from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.models.base import DrivingModel
from cfx.policies.heads.base import ParameterHead


class DirectHead(ParameterHead):
    """Answers are parameters in unit space, within the bounds of calibration."""

    name: ClassVar[str] = "direct"
    learners: ClassVar[tuple[str, ...]] = ("imitation",)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(model.space, device)

    def untrained_answer(self, fixed: Tensor) -> Tensor:
        return fixed

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        return answer
