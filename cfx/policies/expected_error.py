"""What error to expect of a policy with a driver, from its error in the driver's past.

A driver's past is simulated with parameters that have not seen it; the error there times a factor
bounds the error to come. The factor is the 90 % quantile of what left-out drivers' errors grew by,
which makes the bound hold for 90 % of new drivers that are like these: split conformal prediction
(V. Vovk, A. Gammerman and G. Shafer, 2005, *Algorithmic Learning in a Random World*; for regression
J. Lei et al., 2018, JASA 113(523)).

Differences from the source: drivers of several sites are not exchangeable; each site, or fold, has
the same weight in the quantile, and coverage is measured on sites that are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
