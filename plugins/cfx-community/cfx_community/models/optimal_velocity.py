"""The optimal velocity: the speed that drivers choose at a gap. `ovm` and `fvdm` share it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cfx.plugin import Parameter

_BOOK = (
    "default: Treiber and Kesting (2013), section 10.6, motorway;"
    " bounds: about those of Kesting and Treiber (2008)"
)

OPTIMAL_VELOCITY = (
    Parameter("v0", "m/s", 1.0, 70.0, 120 / 3.6, "desired speed on a free road", _BOOK),
    Parameter(
        "width", "m", 1.0, 100.0, 15.0, "interaction length: gap over which the speed rises", _BOOK
    ),
    Parameter(
        "beta",
        "1",
        0.1,
        5.0,
        1.5,
        "form factor: where the speed rises fastest, in interaction lengths",
        _BOOK,
    ),
)


def optimal_velocity(gap: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """Returns V, m/s: `v0 (tanh(gap / width - beta) + tanh(beta)) / (1 + tanh(beta))`.

    V is 0 where the gap, in m, is negative.
    """
    shift = torch.tanh(p["beta"])
    rise = torch.tanh(gap.clamp(min=0.0) / p["width"] - p["beta"]) + shift
    return p["v0"] * rise / (1.0 + shift)
