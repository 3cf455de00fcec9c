"""Statistics over pairs that count the drivers: pairs of one driver are not independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TRIMMED = 0.1
"""Share dropped at each end of the improvements for the trimmed mean, as in the paper."""

_RESAMPLES = 9_999

_MOST_RESAMPLED = 10_000
"""Drivers from which on the interval is the bootstrap's limit: resampling them takes minutes."""

_NORMAL_975 = 1.959964
"""97.5 % quantile of the normal distribution."""

_AT_ONCE = 1_000_000
"""Drivers in all resamples that are computed at once."""

Floats = NDArray[np.float64]

STATISTICS = ("mean", "trimmed_mean", "median", "ci95_low", "ci95_high", "win_rate", "p_value")
"""What metrics tell of an `Improvement`."""


@dataclass(frozen=True)
class Improvement:
    """`(RMSE_baseline - RMSE_policy) / RMSE_baseline` of speed over the pairs (0.1 is 10 %).

    Attributes:
        mean, trimmed_mean, median: over pairs; the trimmed mean drops the top and the bottom 10 %.
        ci95_low, ci95_high: bootstrap confidence interval of the mean; drivers are resampled with
            all their pairs.
        win_rate: share of pairs with a positive improvement.
        p_value: two-sided Wilcoxon signed-rank test of RMSE_baseline against RMSE_policy, means
            over each driver's pairs.
        pairs: number of pairs that count.
        undefined: number of pairs left out because RMSE_baseline is 0 or a rollout diverged.
        drivers: number of drivers of the pairs that count.
    """

    mean: float
    trimmed_mean: float
    median: float
    ci95_low: float
    ci95_high: float
    win_rate: float
    p_value: float
    pairs: int
    undefined: int
    drivers: int

    def metrics(self) -> dict[str, float]:
        """Returns the statistics by name."""
        values = {}
        for name in STATISTICS:
            values[name] = float(getattr(self, name))
        return values


def improvement_statistics(
    baseline: Floats, policy: Floats, drivers: Sequence[str] | None = None, *, seed: int
) -> Improvement:
    """Compares two methods over P pairs.

    Pairs of one driver are not independent: the bootstrap resamples drivers (a cluster bootstrap),
    and the test compares drivers.

    Args:
        baseline: RMSE of speed of each pair, `(P,)`, m/s; a pair counts where both methods' are
            finite and this one is positive.
        policy: that of the other method, `(P,)`, m/s.
        drivers: the driver of each pair, `(P,)`; None if each pair has a driver of its own.
        seed: of the bootstrap.
    """
    from scipy import stats  # slow to import

    counts = np.isfinite(baseline) & np.isfinite(policy) & (baseline > 0)
    before, after = baseline[counts], policy[counts]
    if not counts.any():
        return _undefined(len(baseline))
    if drivers is None:
        who = np.arange(len(before))
    else:
        who = np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]
    gain = (before - after) / before
    low, high = _interval(gain, who, seed)
    number = np.bincount(who)
    before, after = np.bincount(who, before) / number, np.bincount(who, after) / number
    p_value = 1.0  # without a single difference the test has nothing to rank
    if np.any(before != after):
        p_value = float(stats.wilcoxon(before, after, zero_method="zsplit").pvalue)
    return Improvement(
        mean=float(gain.mean()),
        trimmed_mean=float(stats.trim_mean(gain, _TRIMMED)),
        median=float(np.median(gain)),
        ci95_low=low,
        ci95_high=high,
        win_rate=float((gain > 0).mean()),
        p_value=p_value,
        pairs=int(counts.sum()),
        undefined=int((~counts).sum()),
        drivers=len(number),
    )


def mean_interval(
    values: Sequence[float], drivers: Sequence[str], *, seed: int
) -> tuple[float, float, float]:
    """Returns the mean over pairs and its 95 % bootstrap interval over drivers.

    They are NaN where they are not defined.

    Args:
        values: one for each pair; those that are not finite do not count.
        drivers: the driver of each pair.
        seed: of the bootstrap.
    """
    every = np.asarray(values, dtype=np.float64)
    counts = np.isfinite(every)
    if not counts.any():
        return float("nan"), float("nan"), float("nan")
    who = np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]
    low, high = _interval(every[counts], who, seed)
    return float(every[counts].mean()), low, high


def _undefined(pairs: int) -> Improvement:
    """Returns the statistics of pairs none of which counts."""
    nan = float("nan")
    return Improvement(
        mean=nan,
        trimmed_mean=nan,
        median=nan,
        ci95_low=nan,
        ci95_high=nan,
        win_rate=nan,
        p_value=nan,
        pairs=0,
        undefined=pairs,
        drivers=0,
    )


def _interval(gain: Floats, who: NDArray[np.intp], seed: int) -> tuple[float, float]:
    """Returns the 95 % interval of the mean gain; drivers are resampled with all their pairs.

    It is NaN for a single driver. Of very many drivers it is normal, with the standard error of a
    ratio of sums over drivers (W. G. Cochran 1977, Sampling Techniques, chapter 6), which the
    bootstrap tends to.
    """
    from scipy import stats  # slow to import

    number = np.bincount(who).astype(float)
    if len(number) < 2:
        return float("nan"), float("nan")
    if len(number) > _MOST_RESAMPLED:
        average = float(gain.mean())
        residual = np.bincount(who, gain) - average * number
        error = float(np.sqrt(np.square(residual).sum())) / float(number.sum())
        return average - _NORMAL_975 * error, average + _NORMAL_975 * error

    def mean(total: Floats, pairs: Floats, axis: int = -1) -> Floats:
        return np.asarray(total.sum(axis) / pairs.sum(axis))

    interval = stats.bootstrap(
        (np.bincount(who, gain), number),
        mean,
        n_resamples=_RESAMPLES,
        # Alike for any number, but for the memory: they are drawn one after the other.
        batch=max(1, _AT_ONCE // len(number)),
        paired=True,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)
