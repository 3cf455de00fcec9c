"""Choosing between the regimes of a driving model, exactly or smoothly.

A regime model (Wiedemann's) takes one of several accelerations, whichever case holds. The choice is
a step: its gradient with respect to the thresholds is 0 almost everywhere and says nothing of the
jump. Gradient descent cannot see that a shorter time gap would have ended the braking. For
training, a model can be asked for its smoothed self (`DrivingModel.at_temperature`). Each case then
counts with a weight between 0 and 1, a logistic function of the distance from its threshold.
Simulation, calibration and evaluation always take the exact choice.

`safe_sqrt` and `safe_divisor` keep the branch of a `torch.where` that is not taken finite, in value
and in gradient: autograd multiplies its slope by 0, and 0 times infinity is NaN. They replace the
argument before the operation, not the result after it.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "SPACING_WIDTH",
    "SPEED_WIDTH",
    "safe_divisor",
    "safe_sqrt",
    "switches_exactly",
    "where_below",
    "where_up_to",
]
"""What plugins may use, as `cfx.plugin.regimes`."""


Temperature = float | Tensor
"""Width of the smooth switch between regimes, in multiples of the scales below; 0 is exact.

A 0-dimensional tensor may change while compiled code runs, and is never exact.
"""

SPACING_WIDTH = 2.0
"""m: how gradually a threshold of distance is crossed at temperature 1."""

SPEED_WIDTH = 0.5
"""m/s: the same for a threshold of relative speed."""


def switches_exactly(temperature: Temperature) -> bool:
    """Says whether regimes switch exactly."""
    return not isinstance(temperature, Tensor) and temperature == 0


def where_below(
    value: Tensor,
    threshold: Tensor,
    yes: Tensor,
    no: Tensor,
    *,
    scale: float,
    temperature: Temperature = 0.0,
) -> Tensor:
    """Returns `yes` where `value < threshold`, else `no`; a mixture near it at a temperature.

    Args:
        value, threshold, yes, no: `(*batch,)`, broadcasting; finite.
        scale: width of the transition at temperature 1, in the unit of `value`.
        temperature: how gradual; 0 is exact.
    """
    if switches_exactly(temperature):
        return torch.where(value < threshold, yes, no)
    return torch.lerp(no, yes, torch.sigmoid((threshold - value) / (scale * temperature)))


def where_up_to(
    value: Tensor,
    threshold: Tensor,
    yes: Tensor,
    no: Tensor,
    *,
    scale: float,
    temperature: Temperature = 0.0,
) -> Tensor:
    """As `below`, for `value <= threshold`."""
    if switches_exactly(temperature):
        return torch.where(value <= threshold, yes, no)
    return where_below(value, threshold, yes, no, scale=scale, temperature=temperature)


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
