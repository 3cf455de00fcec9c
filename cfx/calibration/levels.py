"""Levels of what a posterior says; imports no torch, for those who only read results."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.9
"""Probability of an interval."""

DETERMINED = 0.3
"""A recording determines a parameter where its interval is narrower than a priori by this share."""

RELIABLE = 0.7
"""Pareto k of weighted samples above which an interval is not to be relied on (Vehtari et al. 2024,
*Pareto smoothed importance sampling*)."""

MIXED = 1.05
"""R-hat above which chains have not come to the same distribution."""

DIVERGENT = 0.01
"""Share of divergent draws above which chains may have left out a part of the posterior."""

ENOUGH = 100.0
"""Effective samples below which the ends of a 90 % interval move by a tenth of its width or so from
one seed to the next (the 5 % point of a normal distribution: standard error 0.21 deviations)."""


def reliable(rows: pd.DataFrame) -> pd.Series:
    """Returns which drivers' intervals are to be relied on.

    Args:
        rows: of the table `fits`, with the diagnostics of weighted samples or of chains.
    """
    if "r_hat" in rows:
        return (rows["r_hat"] <= MIXED) & (rows["divergences"] <= DIVERGENT)
    return rows["pareto_k"] <= RELIABLE
