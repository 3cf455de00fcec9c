"""What is to be expected of a policy's errors: bounds, and what is said of them."""

from __future__ import annotations

import numpy as np

from cfx.policies.context import ExpectedError, conformal_bound


def test_a_bound_holds_for_nine_in_ten_new_drivers() -> None:
    generator = np.random.default_rng(0)
    below = []
    for _ in range(400):
        growth = np.exp(generator.normal(size=51))
        bound = conformal_bound(growth[:50], np.zeros(50, dtype=np.int64))
        below.append(growth[50] <= bound)
    assert 0.86 < np.mean(below) < 0.95


def test_each_fold_counts_once_and_few_drivers_bound_nothing() -> None:
    growth = np.concatenate([np.full(90, 1.0), np.full(10, 3.0)])
    fold = np.repeat([0, 1], [90, 10])
    assert conformal_bound(growth, fold) == 3.0
    assert conformal_bound(growth, np.zeros(100, dtype=np.int64)) == 3.0
    assert conformal_bound(growth[:92], np.zeros(92, dtype=np.int64)) == 1.0
    assert conformal_bound(np.ones(8), np.zeros(8, dtype=np.int64)) is None
    assert conformal_bound(np.array([*np.ones(9), np.nan]), np.zeros(10, dtype=np.int64)) == 1.0


def test_larger_errors_than_those_of_constants_are_warned_of() -> None:
    assert ExpectedError(policy=2.0, own=2.0).of_unseen_in_words() == ""
    better = ExpectedError(unseen=1.2, unseen_constant=1.5).of_unseen_in_words()
    assert "below 1.20 m/s (pooled over the other drivers: 1.50 m/s)" in better
    assert "expect" not in better
    worse = ExpectedError(unseen=3.0, unseen_constant=1.5).of_unseen_in_words()
    assert "expect 2.0 times the error of pooled parameters: train" in worse
