"""Sums and means over the frames that count. Shapes: P pairs, K frames."""

from __future__ import annotations

import torch
from torch import Tensor


def masked_mean(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the mean of `(P, K)` over the counted frames, `(P,)`; NaN where none counts."""
    return torch.where(counted, values, 0.0).sum(1) / counted.sum(1)


def root_mean_square(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the root mean square of `(P, K)` over them, `(P,)`; NaN where none counts."""
    return (torch.where(counted, values, 0.0).square().sum(1) / counted.sum(1)).sqrt()
