from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from cfx.evaluation import statistics
from cfx.evaluation.statistics import improvement_statistics, mean_interval


def test_the_papers_pair() -> None:
    result = improvement_statistics(np.array([1.033]), np.array([0.666]), seed=0)
    assert result.mean == pytest.approx(0.355, abs=5e-4)
    assert math.isnan(result.ci95_low)


def test_the_interval_is_scipys_and_holds_the_mean() -> None:
    rng = np.random.default_rng(1)
    fixed = rng.uniform(0.5, 1.5, 40)
    policy = fixed * rng.uniform(0.7, 1.1, 40)
    result = improvement_statistics(fixed, policy, seed=0)
    assert result.ci95_low < result.mean < result.ci95_high
    # The normal approximation is no different at 40 pairs.
    gain = 1 - policy / fixed
    margin = 1.96 * gain.std(ddof=1) / math.sqrt(40)
    assert result.ci95_low == pytest.approx(gain.mean() - margin, abs=0.3 * margin)
    assert result.p_value == stats.wilcoxon(fixed, policy, zero_method="zsplit").pvalue
    assert result == improvement_statistics(fixed, policy, seed=0)


def test_no_difference_is_no_evidence() -> None:
    result = improvement_statistics(np.ones(10), np.ones(10), seed=0)
    assert (result.mean, result.win_rate, result.p_value, result.ci95_low, result.ci95_high) == (
        0,
        0,
        1,
        0,
        0,
    )


def test_undefined_pairs_are_counted() -> None:
    result = improvement_statistics(
        np.array([1.0, 0.0, np.nan, 2.0]), np.array([0.5, 0.1, 1.0, np.inf]), seed=0
    )
    assert (result.pairs, result.undefined, result.mean) == (1, 3, 0.5)


def test_pairs_of_one_driver_are_drawn_together() -> None:
    rng = np.random.default_rng(2)
    gain = rng.normal(0.1, 0.2, 12)
    fixed = np.ones(12)
    alone = improvement_statistics(fixed, 1 - gain, seed=0)
    # Ten copies of every pair tell nothing new about the drivers; taken for independent pairs, they
    # would narrow the interval.
    drivers = [f"d{k}" for k in range(12)] * 10
    copied = improvement_statistics(np.tile(fixed, 10), np.tile(1 - gain, 10), drivers, seed=0)
    naive = improvement_statistics(np.tile(fixed, 10), np.tile(1 - gain, 10), seed=0)
    assert (copied.pairs, copied.drivers) == (120, 12)
    assert copied.mean == pytest.approx(alone.mean)
    assert copied.p_value == pytest.approx(alone.p_value)
    assert (copied.ci95_low, copied.ci95_high) == pytest.approx(
        (alone.ci95_low, alone.ci95_high), abs=0.01
    )  # other draws
    assert naive.ci95_high - naive.ci95_low < 0.5 * (copied.ci95_high - copied.ci95_low)


def test_a_single_driver_has_no_interval() -> None:
    result = improvement_statistics(np.ones(3), np.array([0.8, 0.9, 1.1]), ["a", "a", "a"], seed=0)
    assert math.isnan(result.ci95_low)
    assert (result.pairs, result.drivers) == (3, 1)


@settings(max_examples=20)  # each draws thousands of bootstrap samples
@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), min_size=2, max_size=12))
def test_nothing_is_invented(values: list[tuple[float, float]]) -> None:
    fixed, policy = np.array(values).T
    result = improvement_statistics(fixed, policy, seed=0)
    gain = (fixed - policy) / fixed
    assert gain.min() - 1e-9 <= result.ci95_low <= result.ci95_high <= gain.max() + 1e-9
    assert 0 <= result.p_value <= 1
    assert result.win_rate == (gain > 0).mean()


def test_a_mean_has_an_interval_over_drivers() -> None:
    values = [0.1, 0.3, 0.2, math.nan, 0.4]
    mean, low, high = mean_interval(values, ["a", "b", "c", "d", "e"], seed=0)
    assert mean == pytest.approx(0.25)
    assert low < mean < high
    assert math.isnan(mean_interval(values, ["a"] * 5, seed=0)[1])
    assert all(math.isnan(value) for value in mean_interval([math.nan], ["a"], seed=0))


def test_of_very_many_drivers_the_interval_is_the_limit_of_the_bootstrap(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Some drivers have several pairs, which are alike."""
    rng = np.random.default_rng(3)
    who = np.sort(rng.integers(0, 400, 1000))
    gain = rng.normal(0.1, 0.2, 1000) + rng.normal(0, 0.3, 400)[who]
    drivers = [str(driver) for driver in who]
    _, low, high = mean_interval(gain.tolist(), drivers, seed=0)
    monkeypatch.setattr(statistics, "_MOST_RESAMPLED", 100)
    mean, lower, higher = mean_interval(gain.tolist(), drivers, seed=0)
    assert mean == pytest.approx(gain.mean())
    assert higher - lower == pytest.approx(high - low, rel=0.05)
    assert lower == pytest.approx(low, abs=0.05 * (high - low))
