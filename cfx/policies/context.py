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
        driver_specific: the base is driver-specific parameters where these are known;
            otherwise it is the agent's base for every driver.
        shrinkage: how far these parameters are shrunk towards the model's default, 0 to 1.
        history_s: measured history that the agent observes before a test, s; None: all there is.
        combines: driver-specific parameters drive beside the agent, where they are known
            (`cfx.evaluation.protocols.past`).
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
    """What bounds 90 % of the errors of speed to come; None where it is not known.

    Attributes:
        policy: factor on the error in a driver's past, of the policy as it was tested, beside
            driver-specific parameters if it was so.
        own: the same of driver-specific parameters.
        unseen: m/s, for drivers of whom nothing is known: RMSE over full trajectories.
        unseen_constant: the same of parameters pooled over the other drivers.
    """

    policy: float | None = None
    own: float | None = None
    unseen: float | None = None
    unseen_constant: float | None = None

    def of_unseen_in_words(self) -> str:
        """Returns what to expect of drivers of whom nothing is known, with a warning; or ""."""
        if self.unseen is None or self.unseen_constant is None:
            return ""
        words = (
            f"of {LEVEL:.0%} of drivers who were left out of its training the RMSE of speed was"
            f" below {self.unseen:.2f} m/s (pooled over the other drivers:"
            f" {self.unseen_constant:.2f} m/s)"
        )
        ratio = self.unseen / self.unseen_constant
        if round(ratio, 1) > 1.0:
            words += (
                f"; expect {ratio:.1f} times the error of pooled parameters: train on recordings"
                " of such drivers"
            )
        return words


def conformal_bound(errors: Floats, group: NDArray[np.int64]) -> float | None:
    """Returns what 90 % of drivers' errors, or of factors by which they grow, stay below.

    Args:
        errors: of each driver, `(D,)`; NaN where it is not known.
        group: the site or fold of each, `(D,)`; each counts once.

    Returns:
        The quantile with the correction for a finite number of drivers; None where nine or fewer
        are known, of whom none is a bound.
    """
    is_known = np.isfinite(errors)
    errors, group = errors[is_known], group[is_known]
    if math.ceil(LEVEL * (len(errors) + 1)) > len(errors):
        return None
    _, number, size = np.unique(group, return_inverse=True, return_counts=True)
    level = LEVEL * (1.0 + 1.0 / len(errors))
    return float(np.quantile(errors, level, method="inverted_cdf", weights=1.0 / size[number]))
