"""Accelerations that are mostly noise."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from cfx.data.accelerations import (
    RECORDED,
    best_average,
    smoothed_twice,
    with_usable_accelerations,
)
from cfx.data.files import Floats
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, write_tidy
from tests.drives import straight_pairs

DT = 0.1
SPEED = 15 + 3 * np.sin(np.arange(600) * DT / 4)
ACCELERATION = np.gradient(SPEED, DT)


def noisy(level: float) -> Floats:
    return ACCELERATION + np.random.default_rng(0).normal(0, level, 600)


def test_smooth_accelerations_are_used_as_recorded() -> None:
    assert best_average(SPEED, ACCELERATION, DT) == RECORDED


def test_the_noisier_the_acceleration_the_longer_the_average() -> None:
    found = [best_average(SPEED, noisy(level), DT).constant for level in (0.3, 1.0, 3.0)]
    assert 0 < found[0] < found[1] < found[2]


def test_the_average_is_nearer_to_the_acceleration_than_what_was_recorded() -> None:
    average = best_average(SPEED, noisy(2.0), DT).of(noisy(2.0), DT)
    assert np.std(average - ACCELERATION) < 0.5 * np.std(noisy(2.0) - ACCELERATION)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=50), st.floats(0.1, 3))
def test_the_average_is_a_critically_damped_filter(values: list[float], constant: float) -> None:
    kept = np.exp(-DT / constant)
    expected = np.array(values)
    for _ in range(2):
        expected, _ = lfilter([1 - kept], [1, -kept], expected, zi=[kept * expected[0]])
    assert smoothed_twice(np.array(values), constant, DT) == pytest.approx(expected, abs=1e-12)


def test_an_acceleration_that_says_nothing_counts_for_nothing() -> None:
    noise = np.random.default_rng(1).normal(0, 1, 600)
    assert best_average(np.full(600, 15.0), noise, DT).factor < 0.1


_FINGERPRINT = """
from tests.data.test_accelerations import fingerprint_of_noisy_pairs
print(fingerprint_of_noisy_pairs())
"""


def fingerprint_of_noisy_pairs() -> str:
    pairs = straight_pairs([600])
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0, 2, 600)
        pair = replace(pairs[0], pair_id=str(seed), follower_speed=SPEED)
        pair = replace(pair, follower_acceleration=ACCELERATION + noise)
        pairs = replace(pairs, pairs=(*pairs.pairs, pair))
    return with_usable_accelerations(pairs, "smooth").fingerprint


def test_every_processor_computes_the_same_averages() -> None:
    # OpenBLAS adds up a dot product in another order where it takes the processor for another one.
    older = {**os.environ, "OPENBLAS_CORETYPE": "Prescott"}
    words = [sys.executable, "-c", _FINGERPRINT]
    done = subprocess.run(words, env=older, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == fingerprint_of_noisy_pairs()


def test_pairs_too_short_to_tell_are_left_alone() -> None:
    assert best_average(SPEED[:40], noisy(3.0)[:40], DT) == RECORDED


def test_what_was_smoothed_is_said_and_can_be_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pair = straight_pairs([600])[0]
    pair = replace(pair, follower_acceleration=noisy(2.0) - ACCELERATION)
    path = tmp_path / "noisy.parquet"
    write_tidy(PairSet((pair,), "test"), path)
    with caplog.at_level(logging.INFO):
        smooth = TidyDataset(path=path, check="off", min_duration=0).load()[0]
    assert "Accelerations of 1 of 1 pairs are noisy" in caplog.text
    assert np.std(smooth.follower_acceleration) < 0.5 * np.std(pair.follower_acceleration)
    assert smooth.leader_acceleration is not smooth.follower_acceleration
    recorded = TidyDataset(path=path, check="off", min_duration=0, accelerations="recorded").load()[
        0
    ]
    assert np.array_equal(recorded.follower_acceleration, pair.follower_acceleration)


def test_real_recordings_are_told_apart(shared_data: Path, i80_pairs: PairSet) -> None:
    assert with_usable_accelerations(i80_pairs, "smooth") is i80_pairs
    ispra = TidyDataset(
        path=shared_data / "openacc_ispra_low_speed_pairs.parquet", min_duration=0
    ).read()
    for pair in ispra:
        average = best_average(pair.follower_speed, pair.follower_acceleration, pair.dt)
        assert average != RECORDED, pair.pair_id
