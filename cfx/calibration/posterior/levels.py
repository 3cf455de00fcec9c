"""Levels of what a posterior says; imports no torch, for those who only read results."""

LEVEL = 0.9
"""Probability of an interval."""

DETERMINED = 0.3
"""A recording determines a parameter where its interval is narrower than a priori by this share."""

RELIABLE = 0.7
"""Pareto k of weighted samples above which an interval is not to be relied on (Vehtari et al. 2024,
*Pareto smoothed importance sampling*)."""
