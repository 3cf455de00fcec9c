"""Normalisation of what networks read.

Shapes: N networks, B drivers of each, W windows, f features.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_LEAST_SCALE = 1e-6
"""A feature whose standard deviation is not above this counts as constant and keeps scale 1."""


class Scaler(nn.Module):
    """Brings features to mean 0 and standard deviation 1 over each network's training windows."""

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        """Takes `(N, f)` each."""
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("scale", scale)

    @classmethod
    def of(cls, values: Tensor, mask: Tensor) -> Scaler:
        """Measures features.

        Args:
            values: `(N, B, W, f)`.
            mask: which windows count, bool `(N, B, W)`.
        """
        weight = mask[..., None].to(values.dtype)
        total = weight.sum((1, 2)).clamp(min=1.0)
        mean = (values * weight).sum((1, 2)) / total
        variance = ((values - mean[:, None, None]).square() * weight).sum((1, 2)) / total
        scale = variance.sqrt()
        return cls(mean, torch.where(scale > _LEAST_SCALE, scale, 1.0))

    def forward(self, values: Tensor) -> Tensor:
        """Returns normalised features `(N, B, W, f)`."""
        return (values - self.mean[:, None, None]) / self.scale[:, None, None]
