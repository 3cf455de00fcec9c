"""Statistics over pairs that count the drivers: pairs of one driver are not independent.

Methods of one job are compared, and jobs: which one is closest to the drivers, and is it chance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfx.evaluation.headline import lower_by, opposite

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Against",
    "against_the_best",
    "improvement_statistics",
    "mean_interval",
    "verdict",
]
"""What plugins may use, as `cfx.plugin.statistics`."""


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
        return {name: float(getattr(self, name)) for name in STATISTICS}


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
        unknown = dict.fromkeys(STATISTICS, math.nan)
        return Improvement(**unknown, pairs=0, undefined=len(baseline), drivers=0)
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
        return math.nan, math.nan, math.nan
    who = np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]
    low, high = _interval(every[counts], who, seed)
    return float(every[counts].mean()), low, high


def _interval(gain: Floats, who: NDArray[np.intp], seed: int) -> tuple[float, float]:
    """Returns the 95 % interval of the mean gain; drivers are resampled with all their pairs.

    It is NaN for a single driver. Of very many drivers it is normal, with the standard error of a
    ratio of sums over drivers (W. G. Cochran 1977, Sampling Techniques, chapter 6), which the
    bootstrap tends to.
    """
    from scipy import stats  # slow to import

    number = np.bincount(who).astype(float)
    if len(number) < 2:
        return math.nan, math.nan
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


_SIGNIFICANT = 0.05
"""p below which a difference counts, corrected for how many are tested."""


class Against(NamedTuple):
    """The best job against another one, over the pairs that both have.

    Attributes:
        best, other: what they are called.
        found: by which share the best one's errors are smaller.
        of_means: by which share its mean error over these pairs is smaller.
        p_value: of the Wilcoxon test, corrected for all comparisons (Holm 1979).
        left_out: pairs that only one of both has.
    """

    best: str
    other: str
    found: Improvement
    of_means: float
    p_value: float
    left_out: int


def against_the_best(errors: Mapping[str, pd.DataFrame]) -> list[Against]:
    """Compares the job with the smallest mean error with each other one, the next best first.

    Args:
        errors: of each job a row per pair: `pair_id`, `driver`, `frames` (that were simulated) and
            `error` (RMSE of speed, m/s). A pair counts where both simulated the same frames.

    Returns:
        Nothing where there are fewer than two jobs that share pairs.
    """
    means = {name: float(table["error"].mean()) for name, table in errors.items()}
    ranked = sorted((mean, name) for name, mean in means.items() if math.isfinite(mean))
    if len(ranked) < 2:
        return []
    best = ranked[0][1]
    compared = []
    for _, other in ranked[1:]:
        both = errors[best].merge(errors[other], on=["pair_id", "frames"], suffixes=("", "_other"))
        if both.empty:
            continue
        before, after = both["error_other"].to_numpy(float), both["error"].to_numpy(float)
        drivers = both["driver"].astype(str).tolist()
        found = improvement_statistics(before, after, drivers, seed=0)
        known = np.isfinite(before) & np.isfinite(after)
        sums = float(before[known].sum()), float(after[known].sum())  # of as many pairs as means
        left_out = len(errors[best]) + len(errors[other]) - 2 * len(both)
        compared.append(Against(best, other, found, lower_by(*sums), found.p_value, left_out))
    corrected = _holm([one.p_value for one in compared])
    return [one._replace(p_value=p) for one, p in zip(compared, corrected, strict=True)]


def _holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for how many there are, by the step-down method of Holm."""
    corrected = list(p_values)
    highest = 0.0
    for place, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        highest = max(highest, min(1.0, p_values[index] * (len(p_values) - place)))
        corrected[index] = highest
    return corrected


def verdict(compared: Sequence[Against]) -> str:
    """Returns in one sentence which job is closest to the drivers; "" if nothing was compared."""
    if not compared:
        return ""
    least = compared[0]
    ahead = [one for one in compared if one.p_value < _SIGNIFICANT and one.found.mean > 0]
    text = f"Closest to the drivers: {least.best}"
    if not ahead:
        text += ", but not significantly"
    elif len(ahead) == len(compared):
        text += ", significantly"
    else:
        text += f", significantly closer than {len(ahead)} of {len(compared)} others"
    found = least.found
    interval = "one driver"
    if math.isfinite(found.ci95_low):
        interval = f"{100 * found.ci95_low:+.1f} to {100 * found.ci95_high:+.1f}"
    otherwise = opposite(found.mean, least.of_means)
    if otherwise:
        interval += f"; {otherwise}"
    text += (
        f"; over the next best, {least.other}, {100 * found.mean:+.1f} % ({interval}), better for"
        f" {found.win_rate * found.pairs:.0f} of {found.pairs} pairs, p = {least.p_value:.2g}"
    )
    if len(compared) > 1:
        text += " after Holm"
    if least.left_out:
        text += f"; {least.left_out} pairs that only one of both has do not count"
    return f"{text}."
