"""Policies of constant parameters, which no learner trains: default and driver-specific ones."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.policies.base import ConstantNetwork, Policy, PolicyNetwork, ResidualSettings


class FixedPolicy(Policy):
    """Answers driver-specific parameters, always."""

    schema: ClassVar[type[Settings]] = ResidualSettings
    settings: ResidualSettings
    trainable = False
    adapts = False

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return ConstantNetwork(fixed)


class DefaultPolicy(Policy):
    """Answers the model's default parameters, always."""

    schema: ClassVar[type[Settings]] = Settings
    trainable = False
    adapts = False

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return ConstantNetwork(default.expand_as(fixed))
