"""Arithmetic that stays finite in the branch of a `torch.where` that is not taken.

It stays finite in value and in gradient. Autograd multiplies the slope of the branch not taken by
0. Where that slope is infinite (a square root at 0, a division by 0) the product is NaN. These
functions replace the argument before the operation instead of the result after it.
"""

from __future__ import annotations

import torch
from torch import Tensor


def safe_sqrt(value: Tensor) -> Tensor:
    """Returns `sqrt(value)` where `value > 0`, and 0 with slope 0 elsewhere."""
    positive = value > 0
    return torch.where(positive, torch.sqrt(torch.where(positive, value, 1.0)), 0.0)


def safe_divisor(value: Tensor, used: Tensor) -> Tensor:
    """Returns `value` where `used`, 1 elsewhere: a divisor for the branch that `used` selects.

    Args:
        value: `(*batch,)`.
        used: bool, `(*batch,)`; True only where `value` is not 0.
    """
    return torch.where(used, value, 1.0)
