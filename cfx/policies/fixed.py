"""The baseline `fixed`: the calibrated parameters, always."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from cfx.core.component import Settings
from cfx.policies.base import ConstantNetwork, Policy, PolicyNetwork, ResidualSettings


class FixedPolicy(Policy):
    """Answers the fixed parameters that calibration found."""

    schema: ClassVar[type[Settings]] = ResidualSettings
    settings: ResidualSettings
    trainable = False
    adapts = False

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return ConstantNetwork(fixed)
