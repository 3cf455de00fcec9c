"""Context of drivers: base parameters and driver features, known before driving.

Shapes: D drivers, n tuned parameters, k driver features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
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
            known (`cfx.evaluation.protocols.past`).
    """

    driver_specific: bool = True
    shrinkage: float = 0.0
    history_s: float | None = None
    combines: bool = False


LEVEL = 0.9
"""Share of drivers for whom a bound holds."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ExpectedError:
    """Factors on the errors in drivers' pasts that bound 90 % of the errors to come.

    Attributes:
        policy: of the policy as it was tested, beside drivers' own parameters if it was so.
        own: of the drivers' own parameters.
    """

    policy: float
    own: float


def growth_bound(growth: Floats, group: NDArray[np.int64]) -> float:
    """Returns the factor that 90 % of drivers' errors grow by at most.

    Args:
        growth: error in the test over error in the past, `(D,)`; NaN where it is not known.
        group: the site or fold of each, `(D,)`; each counts once.

    Returns:
        The quantile with the correction for a finite number of drivers; NaN where nine or fewer are
        known, of whom none is a bound.
    """
    known = np.isfinite(growth)
    growth, group = growth[known], group[known]
    if math.ceil(LEVEL * (len(growth) + 1)) > len(growth):
        return math.nan
    _, number, size = np.unique(group, return_inverse=True, return_counts=True)
    level = LEVEL * (1.0 + 1.0 / len(growth))
    return float(np.quantile(growth, level, method="inverted_cdf", weights=1.0 / size[number]))
