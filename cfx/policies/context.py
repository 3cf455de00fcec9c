"""Context of drivers: base parameters and driver features, known before driving.

Shapes: D drivers, n tuned parameters, k driver features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class DriverContext(NamedTuple):
    """Context of D drivers; an empty one is that of unseen drivers.

    Attributes:
        base: parameters that answers refer to, `(D, n)`, or those of the driving model alone, `(D,
            m)`, SI units; None: the agent's own base.
        driver_features: `(D, k)`, NaN where unknown; None: unknown for all. The mean over the
            training drivers stands for what is unknown.
    """

    base: Tensor | None = None
    driver_features: Tensor | None = None


UNSEEN = DriverContext()
"""Context of drivers of whom nothing is known."""


@dataclass(frozen=True)
class ContextRule:
    """Makes a driver's context for an agent, as in training.

    Attributes:
        driver_specific: the base is the driver's own calibrated parameters where these are known;
            otherwise it is the agent's base for every driver.
        shrinkage: how far these parameters are shrunk towards the model's default, 0 to 1.
        history_s: measured history that the agent observes before a test, s; None: all there is.
        combines: the driver's own calibrated parameters drive beside the agent, where they are
            known (`cfx.evaluation.combination`).
    """

    driver_specific: bool = True
    shrinkage: float = 0.0
    history_s: float | None = None
    combines: bool = False
