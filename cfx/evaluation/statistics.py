"""Statistics over drivers: pairs of one driver are not independent.

Methods of one job are compared, and jobs: which one is closest to the drivers, and is it chance.

An improvement is geometric, `1 - exp(mean of log(error / baseline))`. A mean of ratios, which the
paper prints, is below zero where two methods are equally good, since a ratio above 1
weighs more than one below: -3 % where the logarithms differ by a noise of 0.25. Averages of
logarithms have no such bias, and the t interval of their mean holds its level for few drivers too
(`tests/evaluation/test_level.py` measures both).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfx.evaluation.headline import interval_in_words, lower_by, summaries_disagree

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Against",
    "OverSites",
    "geometric_over_sites",
    "improvement_statistics",
    "mean_interval",
    "ranking_of",
    "verdict",
]
"""What plugins may use, as `cfx.plugin.statistics`."""


_TRIMMED = 0.1
"""Share dropped at each end of the ratios for the trimmed mean, as in the paper."""

_LEVEL = 0.95
"""Of intervals."""

Floats = NDArray[np.float64]

STATISTICS = (
    "geometric",
    "ci95_low",
    "ci95_high",
    "ratio_of_means",
    "median",
    "win_rate",
    "p_value",
    "mean_ratio",
    "trimmed_mean_ratio",
    "drivers",
)
"""What metrics tell of an `Improvement`."""


@dataclass(frozen=True)
class Improvement:
    """By which share a method's errors are smaller than a baseline's (0.1 is 10 %).

    Attributes:
        geometric: `1 - exp(mean over drivers of log(error / baseline))`; the logarithm of a driver
            is the mean over their pairs.
        ci95_low, ci95_high: its 95 % interval: Student's t over the drivers' logarithms; NaN for a
            single driver.
        ratio_of_means: `1 - mean error / mean error of the baseline`, means over pairs.
        median: over drivers.
        win_rate: share of pairs with a smaller error.
        p_value: two-sided t test of the drivers' logarithms; below 0.05 exactly where the interval
            excludes 0. NaN for a single driver.
        mean_ratio, trimmed_mean_ratio: the paper's: the mean over pairs of `1 - error / baseline`,
            all and without the top and the bottom 10 %. Biased below 0.
        pairs: number of pairs that count.
        undefined: number of pairs left out because an error is 0 or not finite.
        drivers: number of drivers of the pairs that count.
    """

    geometric: float
    ci95_low: float
    ci95_high: float
    ratio_of_means: float
    median: float
    win_rate: float
    p_value: float
    mean_ratio: float
    trimmed_mean_ratio: float
    pairs: int
    undefined: int
    drivers: int

    def metrics(self) -> dict[str, float]:
        """Returns the statistics by name."""
        return {name: float(getattr(self, name)) for name in STATISTICS}


def are_comparable(baseline: Floats, errors: Floats) -> NDArray[np.bool_]:
    """Returns which pairs count, `(P,)`: the ratio of their two errors has a finite logarithm."""
    return np.isfinite(baseline) & np.isfinite(errors) & (baseline > 0) & (errors > 0)


def improvement_statistics(
    baseline: Floats, errors: Floats, drivers: Sequence[str] | None = None
) -> Improvement:
    """Compares two methods over P pairs.

    Args:
        baseline: error of each pair, `(P,)`; a pair counts where both methods' are finite and
            positive.
        errors: that of the other method, `(P,)`, in the same unit.
        drivers: the driver of each pair, `(P,)`; None if each pair has a driver of its own.
    """
    counts = are_comparable(baseline, errors)
    if not counts.any():
        unknown = dict.fromkeys(STATISTICS[:-1], math.nan)
        return Improvement(**unknown, pairs=0, undefined=len(baseline), drivers=0)
    before, after = baseline[counts], errors[counts]
    logarithms = _logarithms(before, after, _numbered(drivers, counts))
    low, high, p_value = _t_interval(logarithms)
    gain = (before - after) / before
    dropped = int(_TRIMMED * len(gain))
    return Improvement(
        geometric=-math.expm1(logarithms.mean()),
        ci95_low=-math.expm1(high),
        ci95_high=-math.expm1(low),
        ratio_of_means=lower_by(float(before.mean()), float(after.mean())),
        median=-math.expm1(float(np.median(logarithms))),
        win_rate=float((after < before).mean()),
        p_value=p_value,
        mean_ratio=float(gain.mean()),
        trimmed_mean_ratio=float(np.sort(gain)[dropped : len(gain) - dropped].mean()),
        pairs=int(counts.sum()),
        undefined=int((~counts).sum()),
        drivers=len(logarithms),
    )


def mean_interval(values: Sequence[float], drivers: Sequence[str]) -> tuple[float, float, float]:
    """Returns the mean over pairs and its 95 % interval over drivers.

    They are NaN where they are not defined; the interval of a single driver is not. Its standard
    error is that of a ratio of sums over drivers (W. G. Cochran 1977, Sampling Techniques, chapter
    6), its quantile Student's t.

    Args:
        values: one for each pair; those that are not finite do not count.
        drivers: the driver of each pair.
    """
    every = np.asarray(values, dtype=np.float64)
    counts = np.isfinite(every)
    if not counts.any():
        return math.nan, math.nan, math.nan
    driver = _numbered(drivers, counts)
    mean = float(every[counts].mean())
    number = np.bincount(driver)
    if len(number) < 2:
        return mean, math.nan, math.nan
    residual = np.bincount(driver, every[counts]) - mean * number
    variance = float(np.square(residual).sum()) * len(number) / (len(number) - 1)
    margin = _t_quantile(len(number) - 1) * math.sqrt(variance) / float(number.sum())
    return mean, mean - margin, mean + margin


def _numbered(drivers: Sequence[str] | None, counts: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Numbers the drivers of the pairs that count, and returns each pair's number."""
    if drivers is None:
        return np.arange(int(counts.sum()))
    return np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]


def _logarithms(before: Floats, after: Floats, driver: NDArray[np.intp]) -> Floats:
    """Returns each driver's mean of the logarithms of their pairs' ratios, `(drivers,)`."""
    return np.bincount(driver, np.log(after / before)) / np.bincount(driver)


def _t_interval(values: Floats) -> tuple[float, float, float]:
    """Returns the 95 % t interval of a mean and the p value of its being 0; NaN of one value."""
    from scipy.special import stdtr

    if len(values) < 2:
        return math.nan, math.nan, math.nan
    mean = float(values.mean())
    error = float(values.std(ddof=1)) / math.sqrt(len(values))
    margin = _t_quantile(len(values) - 1) * error
    if error == 0.0:
        return mean, mean, 1.0 if mean == 0.0 else 0.0
    p_value = 2.0 * float(stdtr(len(values) - 1, -abs(mean) / error))
    return mean - margin, mean + margin, p_value


def _t_quantile(freedom: float) -> float:
    """Returns how many standard errors a 95 % interval reaches to each side."""
    from scipy.special import stdtrit  # scipy.stats takes a second to import

    return float(stdtrit(freedom, (1.0 + _LEVEL) / 2.0))


class OverSites(NamedTuple):
    """A geometric improvement in which each site counts once.

    Attributes:
        geometric, ci95_low, ci95_high: as in `Improvement`.
        p_value: two-sided; below 0.05 exactly where the interval excludes 0.
    """

    geometric: float
    ci95_low: float
    ci95_high: float
    p_value: float


def geometric_over_sites(
    baseline: Floats, errors: Floats, drivers: Sequence[str], sites: Sequence[str]
) -> OverSites:
    """Returns the geometric improvement in which each site counts once, and its 95 % interval.

    The sites are those at hand, not a sample of all sites: the interval is over the drivers of each
    (a stratified mean; W. G. Cochran 1977, Sampling Techniques, chapter 5), with the degrees of
    freedom of F. E. Satterthwaite (1946, Biometrics Bulletin 2, 110). A site of a single driver has
    the variance of the others' drivers. NaN where it is not defined.

    Args:
        baseline, errors, drivers: as for `improvement_statistics`.
        sites: the site of each pair, `(P,)`.
    """
    from scipy.special import stdtr

    means, variances, numbers = [], [], []
    of_site, comparable = np.asarray(sites), are_comparable(baseline, errors)
    for site in dict.fromkeys(sites):
        counts = comparable & (of_site == site)
        if not counts.any():
            continue
        logarithms = _logarithms(baseline[counts], errors[counts], _numbered(drivers, counts))
        means.append(float(logarithms.mean()))
        numbers.append(len(logarithms))
        variances.append(float(logarithms.var(ddof=1)) if len(logarithms) > 1 else math.nan)
    if not means:
        return OverSites(math.nan, math.nan, math.nan, math.nan)
    mean = float(np.mean(means))
    number, variance = np.array(numbers, dtype=float), np.array(variances)
    has_variance = number > 1
    if not has_variance.any():
        return OverSites(-math.expm1(mean), math.nan, math.nan, math.nan)
    freedom = number - 1
    pooled = float((variance * freedom)[has_variance].sum() / freedom[has_variance].sum())
    squares = np.where(has_variance, variance, pooled) / number / len(number) ** 2
    total = float(squares.sum())
    if total == 0.0:
        same = -math.expm1(mean)
        return OverSites(same, same, same, 1.0 if mean == 0.0 else 0.0)
    pooled_freedom = freedom[has_variance].sum()
    degrees = total**2 / float((squares**2 / np.where(has_variance, freedom, pooled_freedom)).sum())
    margin = _t_quantile(degrees) * math.sqrt(total)
    p_value = 2.0 * float(stdtr(degrees, -abs(mean) / math.sqrt(total)))
    return OverSites(
        -math.expm1(mean), -math.expm1(mean + margin), -math.expm1(mean - margin), p_value
    )


_SIGNIFICANT = 0.05
"""Share of families of comparisons in which one that is only chance may be called significant."""


class Against(NamedTuple):
    """The best job against another one, over the pairs that all jobs have.

    Attributes:
        best, other: what they are called.
        improvement: by which share the best one's errors are smaller.
        p_value: of its t test over drivers, corrected for all comparisons of two jobs.
    """

    best: str
    other: str
    improvement: Improvement
    p_value: float


class Ranking(NamedTuple):
    """Jobs that were tested on the same pairs, the smallest error first.

    Attributes:
        jobs: their names, the smallest mean error first.
        errors: of each the mean error over these pairs.
        pairs: on how many pairs they are compared.
        against: the best one against each other.
        apart: jobs that were tested on other pairs or other frames, which are not ranked.
    """

    jobs: tuple[str, ...]
    errors: tuple[float, ...]
    pairs: int
    against: tuple[Against, ...]
    apart: tuple[str, ...]


def ranking_of(
    errors: Mapping[str, Sequence[pd.DataFrame]], sites: Mapping[str, str] | None = None
) -> Ranking:
    """Ranks jobs by their mean error, and compares the best one with each other.

    The best is chosen by the errors that then test it, so that the best of many equal jobs would
    often seem significantly better than one of them. All comparisons of two jobs are therefore
    corrected together, by the step-down method of S. Holm (1979, Scandinavian Journal of Statistics
    6, 65): whichever is the best, one of its comparisons is called significant by chance in at most
    5 % of such families.

    Args:
        errors: of each job, for each of its seeds, a row per pair: `pair_id`, `driver`, `frames`
            (that were simulated) and `error`. A pair's error is the mean over seeds. Jobs are
            compared that simulated the same frames of the same pairs; of several such groups the
            largest counts, of groups of one size the first.
        sites: the site of each pair, by its id: each site counts once, and jobs are ranked by their
            geometric mean error, where a site's is that of its drivers. None: all drivers count
            alike, and jobs are ranked by their mean error over pairs.
    """
    tables = {name: _over_seeds(of_seeds) for name, of_seeds in errors.items()}
    groups: dict[frozenset[tuple[object, object]], list[str]] = {}
    for name, table in tables.items():
        tested = frozenset(zip(table["pair_id"], table["frames"], strict=True))
        groups.setdefault(tested, []).append(name)
    if not groups:
        return Ranking((), (), 0, (), ())
    tested, names = max(groups.items(), key=lambda group: len(group[1]))
    drivers = tables[names[0]].set_index("pair_id")["driver"].astype(str)
    aligned = {}
    for name in names:
        errors_of_pairs = tables[name].set_index("pair_id")["error"]
        aligned[name] = errors_of_pairs.reindex(drivers.index)
    of_pair = None if sites is None else [sites[pair_id] for pair_id in drivers.index]
    means = {}
    for name, column in aligned.items():
        means[name] = _mean_error(column, drivers.tolist(), of_pair)
    ranked = sorted(names, key=lambda name: _finite_first(means[name]))
    compared: dict[tuple[str, str], Improvement] = {}
    for better, worse in combinations(ranked, 2):
        before, after = aligned[worse].to_numpy(float), aligned[better].to_numpy(float)
        improvement = improvement_statistics(before, after, drivers.tolist())
        if of_pair is not None:
            over_sites = geometric_over_sites(before, after, drivers.tolist(), of_pair)
            improvement = replace(improvement, **over_sites._asdict())
        compared[better, worse] = improvement
    p_values = [improvement.p_value for improvement in compared.values()]
    corrected = dict(zip(compared, _holm(p_values), strict=True))
    against = []
    for other in ranked[1:]:
        key = ranked[0], other
        against.append(Against(*key, compared[key], corrected[key]))
    not_comparable = [name for name in errors if name not in ranked]
    mean_errors = tuple(means[name] for name in ranked)
    return Ranking(tuple(ranked), mean_errors, len(tested), tuple(against), tuple(not_comparable))


def _mean_error(errors: pd.Series, drivers: Sequence[str], sites: Sequence[str] | None) -> float:
    """Returns the mean error over pairs, or the geometric one in which each site counts once."""
    values = errors.to_numpy(float)
    if sites is None:
        return float(errors.mean(skipna=False))
    return 1.0 - geometric_over_sites(np.ones_like(values), values, drivers, sites).geometric


def _over_seeds(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Returns the mean error of each pair over tables of several seeds."""
    import pandas as pd

    if len(tables) == 1:
        return tables[0]
    together = pd.concat(tables).groupby(["pair_id", "driver", "frames"], sort=False)
    return together[["error"]].mean().reset_index()


def _finite_first(error: float) -> float:
    """Returns what an error is sorted by: one that is not known comes last."""
    return error if math.isfinite(error) else math.inf


def _holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for how many there are, by the step-down method of Holm.

    One that is not known counts as a comparison, and stays unknown.
    """
    corrected = list(p_values)
    highest = 0.0
    order = sorted(range(len(p_values)), key=lambda index: _finite_first(p_values[index]))
    for place, index in enumerate(order):
        if math.isfinite(p_values[index]):
            highest = max(highest, min(1.0, p_values[index] * (len(p_values) - place)))
            corrected[index] = highest
    return corrected


def verdict(ranking: Ranking) -> str:
    """Returns in one sentence which job is closest to the drivers; "" if nothing was compared."""
    if not ranking.against:
        return ""
    ahead = 0
    for comparison in ranking.against:
        is_significant = comparison.p_value < _SIGNIFICANT
        ahead += is_significant and comparison.improvement.geometric > 0
    next_best, improvement = ranking.against[0], ranking.against[0].improvement
    text = f"Closest to the drivers: {next_best.best}"
    others = len(ranking.against)
    if not ahead:
        text += ", but not significantly"
    elif ahead == others:
        text += ", significantly"
    else:
        text += f", but significantly closer than only {ahead} of {others} others"
    interval = interval_in_words(improvement.ci95_low, improvement.ci95_high)
    note = summaries_disagree(improvement.geometric, improvement.ratio_of_means)
    if note:
        interval += f"; {note}"
    better = f"{improvement.win_rate * improvement.pairs:.0f} of {improvement.pairs}"
    text += (
        f"; over the next best, {next_best.other}, {100 * improvement.geometric:+.1f} %"
        f" ({interval}), better for {better} pairs"
    )
    if math.isfinite(next_best.p_value):
        text += f", p = {next_best.p_value:.2g}"
        if len(ranking.against) > 1:
            text += " after Holm"
    if ranking.apart:
        count = len(ranking.apart)
        text += (
            f"; {count} job{'s' if count > 1 else ''} tested on other pairs or frames"
            f" {'are' if count > 1 else 'is'} not ranked"
        )
    return f"{text}."
