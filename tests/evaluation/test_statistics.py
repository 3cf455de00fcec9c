"""Statistics over drivers, against SciPy's and against what they promise of equal methods."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cfx.evaluation.statistics import (
    geometric_over_sites,
    improvement_statistics,
    mean_interval,
    ranking_of,
    verdict,
)


def test_the_papers_pair() -> None:
    result = improvement_statistics(np.array([1.033]), np.array([0.666]))
    assert result.mean_ratio == pytest.approx(0.355, abs=5e-4)
    assert result.geometric == pytest.approx(result.ratio_of_means)
    assert math.isnan(result.ci95_low)
    assert math.isnan(result.p_value)


def test_the_interval_is_scipys_of_logarithms() -> None:
    rng = np.random.default_rng(1)
    fixed = rng.uniform(0.5, 1.5, 40)
    policy = fixed * rng.uniform(0.7, 1.1, 40)
    result = improvement_statistics(fixed, policy)
    test = stats.ttest_1samp(np.log(policy / fixed), 0.0)
    low, high = test.confidence_interval(0.95)
    assert (result.ci95_low, result.ci95_high) == pytest.approx((1 - np.exp(high), 1 - np.exp(low)))
    assert result.p_value == pytest.approx(test.pvalue)
    assert result.geometric == pytest.approx(1 - stats.gmean(policy / fixed))
    assert result.trimmed_mean_ratio == pytest.approx(stats.trim_mean(1 - policy / fixed, 0.1))


def test_no_difference_is_no_evidence() -> None:
    result = improvement_statistics(np.ones(10), np.ones(10))
    assert (result.geometric, result.win_rate, result.p_value) == (0, 0, 1)
    assert (result.ci95_low, result.ci95_high) == (0, 0)


def test_undefined_pairs_are_counted() -> None:
    baseline, policy = np.array([1.0, 0.0, np.nan, 2.0, 1.0]), np.array([0.5, 0.1, 1, np.inf, 0])
    result = improvement_statistics(baseline, policy)
    assert (result.pairs, result.undefined, result.geometric) == (1, 4, 0.5)
    nothing = improvement_statistics(np.zeros(2), np.ones(2))
    assert (nothing.pairs, nothing.undefined, nothing.drivers) == (0, 2, 0)
    assert math.isnan(nothing.geometric)


def test_pairs_of_one_driver_count_as_one() -> None:
    rng = np.random.default_rng(2)
    policy = np.exp(rng.normal(-0.1, 0.2, 12))
    alone = improvement_statistics(np.ones(12), policy)
    # Ten copies of every pair tell nothing new about the drivers; taken for independent pairs, they
    # would narrow the interval.
    drivers = [f"d{k}" for k in range(12)] * 10
    copied = improvement_statistics(np.ones(120), np.tile(policy, 10), drivers)
    assert (copied.pairs, copied.drivers) == (120, 12)
    for name in ("geometric", "ci95_low", "ci95_high", "p_value"):
        assert getattr(copied, name) == pytest.approx(getattr(alone, name))
    naive = improvement_statistics(np.ones(120), np.tile(policy, 10))
    assert naive.ci95_high - naive.ci95_low < 0.5 * (copied.ci95_high - copied.ci95_low)


@given(st.lists(st.tuples(st.floats(0.5, 2), st.floats(0.5, 2)), min_size=3, max_size=12))
def test_to_be_better_is_the_other_to_be_worse(values: list[tuple[float, float]]) -> None:
    """Of logarithms alone: 1 - 1 / (1 - improvement) the other way round; a mean of ratios is not."""
    baseline, policy = np.array(values).T
    forth, back = improvement_statistics(baseline, policy), improvement_statistics(policy, baseline)
    for one, other in (("geometric", "geometric"), ("ci95_low", "ci95_high")):
        product = (1 - getattr(forth, one)) * (1 - getattr(back, other))
        assert product == pytest.approx(1.0)
    assert forth.p_value == pytest.approx(back.p_value)
    excludes = forth.ci95_low > 0 or forth.ci95_high < 0
    if abs(forth.p_value - 0.05) > 1e-6:
        assert excludes == (forth.p_value < 0.05)


def test_a_mean_has_an_interval_over_drivers() -> None:
    values = [0.1, 0.3, 0.2, math.nan, 0.4]
    mean, low, high = mean_interval(values, ["a", "b", "c", "d", "e"])
    expected = stats.ttest_1samp([0.1, 0.3, 0.2, 0.4], 0.0).confidence_interval(0.95)
    assert (mean, low, high) == pytest.approx((0.25, expected.low, expected.high))
    assert math.isnan(mean_interval(values, ["a"] * 5)[1])
    assert all(math.isnan(value) for value in mean_interval([math.nan], ["a"]))


def test_the_interval_of_drivers_with_several_pairs_is_the_bootstraps() -> None:
    rng = np.random.default_rng(3)
    who = np.sort(rng.integers(0, 200, 500))
    gain = rng.normal(0.1, 0.2, 500) + rng.normal(0, 0.3, 200)[who]
    _, low, high = mean_interval(gain.tolist(), [str(driver) for driver in who])
    total, number = np.bincount(who, gain), np.bincount(who)
    present = number > 0

    def mean(total: np.ndarray, number: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.asarray(total.sum(axis) / number.sum(axis))

    bootstrap = stats.bootstrap(
        (total[present], number[present]), mean, paired=True, method="percentile", rng=rng
    ).confidence_interval
    assert (low, high) == pytest.approx((bootstrap.low, bootstrap.high), abs=0.003)


def test_each_site_counts_once_however_many_drivers_it_has() -> None:
    rng = np.random.default_rng(4)
    logarithms = np.concatenate([rng.normal(-0.2, 0.1, 30), rng.normal(0.1, 0.1, 10)])
    sites = ["A"] * 30 + ["B"] * 10
    drivers = [f"d{k}" for k in range(40)]
    mean, low, high, p = geometric_over_sites(np.ones(40), np.exp(logarithms), drivers, sites)
    both = (logarithms[:30].mean() + logarithms[30:].mean()) / 2
    assert mean == pytest.approx(1 - np.exp(both))
    # Welch's test compares two means; the mean of two has half the error of their difference.
    welch = stats.ttest_ind(logarithms[:30], -logarithms[30:], equal_var=False)
    ends = welch.confidence_interval(0.95)
    assert low == pytest.approx(1 - np.exp(ends.high / 2))
    assert high == pytest.approx(1 - np.exp(ends.low / 2))
    assert p == pytest.approx(welch.pvalue)
    alone = geometric_over_sites(np.ones(2), np.array([0.9, 0.8]), ["a", "b"], ["A", "B"])
    assert alone[0] == pytest.approx(1 - math.sqrt(0.72))
    assert math.isnan(alone[1])


def test_a_ranking_over_sites_counts_each_site_once() -> None:
    """Thirty drivers of one site do not outvote three of each of two others."""
    rng = np.random.default_rng(5)
    noise = rng.normal(0.0, 0.02, 36)
    gain = np.concatenate([np.full(30, -0.1), np.full(6, 0.3)])
    tables = jobs(np.zeros(36), gain + noise)
    sites = {f"p{k}": "A" if k < 30 else "BC"[k % 2] for k in range(36)}
    over_pairs, over_sites = ranking_of(tables), ranking_of(tables, sites)
    assert over_pairs.jobs == ("job 1", "job 0")
    assert over_sites.jobs == ("job 0", "job 1")
    means = [noise[:30].mean() - 0.1]
    for number in range(2):
        means.append(0.3 + noise[30 + number :: 2].mean())
    assert over_sites.errors[1] == pytest.approx(np.exp(np.mean(means)))
    assert over_sites.against[0].p_value < 1e-4


def jobs(*logarithms: np.ndarray) -> dict[str, list[pd.DataFrame]]:
    """Returns jobs of one seed whose errors are the exponential of these, a pair per driver."""
    tables = {}
    for number, values in enumerate(logarithms):
        ids = [f"p{k}" for k in range(len(values))]
        table = {"pair_id": ids, "driver": ids, "frames": 100, "error": np.exp(values)}
        tables[f"job {number}"] = [pd.DataFrame(table)]
    return tables


def test_of_equal_jobs_none_is_called_significantly_closer() -> None:
    """The best of several is chosen by the errors that test it: `test_level` has the table.

    Of 200 families 5 % are 10; 20 are three standard deviations more.
    """
    rng = np.random.default_rng(5)
    wrong = 0
    for _ in range(200):
        drivers = rng.normal(0.0, 0.3, 20)
        ranking = ranking_of(jobs(*(drivers + rng.normal(0, 0.25, (4, 20)))))
        wrong += ", but not significantly" not in verdict(ranking)
    assert wrong <= 20


def test_jobs_on_other_pairs_are_not_ranked() -> None:
    rng = np.random.default_rng(6)
    tables = jobs(*rng.normal(0.0, 0.1, (3, 12)))
    tables["elsewhere"] = [tables["job 0"][0].assign(frames=50, error=0.001)]
    ranking = ranking_of(tables)
    assert set(ranking.jobs) == {"job 0", "job 1", "job 2"}
    assert ranking.apart == ("elsewhere",)
    assert "1 job tested on other pairs or frames is not ranked" in verdict(ranking)
    assert verdict(ranking_of({"alone": tables["job 0"]})) == ""


def test_a_job_of_several_seeds_is_ranked_by_its_mean_error() -> None:
    """A single seed that was lucky comes before no job that is better on average."""
    lucky, unlucky, steady = np.full(6, math.log(0.1)), np.zeros(6), np.full(6, math.log(0.5))
    tables = jobs(lucky, unlucky, steady)
    seeds = {"two seeds": [*tables["job 0"], *tables["job 1"]], "one": tables["job 2"]}
    ranking = ranking_of(seeds)
    assert ranking.jobs == ("one", "two seeds")
    assert ranking.errors == pytest.approx((0.5, 0.55))


def test_mean_errors_that_say_the_opposite_are_told() -> None:
    a, b = np.zeros(20), np.full(20, math.log(0.7))
    b[0], a[0] = 0.0, math.log(0.0001)
    ranking = ranking_of(jobs(a, b))
    (against,) = ranking.against
    assert against.best == "job 1"
    assert against.improvement.geometric < 0 < against.improvement.ratio_of_means
    said = f"of the mean errors {100 * against.improvement.ratio_of_means:+.1f} %"
    assert said in verdict(ranking)


def test_one_driver_gives_no_significance() -> None:
    said = verdict(ranking_of(jobs(np.array([0.0]), np.array([math.log(2.0)]))))
    assert said == (
        "Closest to the drivers: job 0, but not significantly; over the next best, job 1, +50.0 %"
        " (one driver), better for 1 of 1 pairs."
    )


def test_a_verdict_says_how_many_of_the_others_are_significantly_worse() -> None:
    noise = 0.05 * np.random.default_rng(0).standard_normal((2, 40))
    alike, worse = noise[0] + 1e-4, noise[1] + 0.5
    said = verdict(ranking_of(jobs(np.zeros(40), alike - alike.mean() + 1e-4, worse)))
    assert said.startswith(
        "Closest to the drivers: job 0, but significantly closer than only 1 of 2 others; over"
    )
