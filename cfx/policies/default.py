"""The baseline `default`: the model's default parameters, always."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.policies.base import ConstantNetwork, Policy, PolicyNetwork


class DefaultPolicy(Policy):
    """Answers the model's default parameters."""

    schema: ClassVar[type[Settings]] = Settings
    trainable = False
    adapts = False

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return ConstantNetwork(default.expand_as(fixed))
