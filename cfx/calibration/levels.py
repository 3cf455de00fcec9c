"""Levels of what a posterior says; imports no torch, for those who only read results."""

LEVEL = 0.9
"""Probability of an interval."""

DETERMINED = 0.3
"""A recording determines a parameter where its interval is narrower than a priori by this share."""

RELIABLE = 0.7
"""Pareto k of weighted samples above which an interval is not to be relied on (Vehtari et al. 2024,
*Pareto smoothed importance sampling*)."""

ENOUGH = 100.0
"""Effective samples below which the ends of a 90 % interval move by a tenth of its width or so from
one seed to the next (the 5 % point of a normal distribution: standard error 0.21 deviations)."""
