"""Scores of sampled forecasts, beside closed forms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from cfx.evaluation.forecasts import Origins, Paths
from cfx_forecasts.distributions import (
    DISTRIBUTION_COLUMNS,
    Recorded,
    distribution_metrics,
    score_distributions,
    summarize_distributions,
)

DT = 0.1
STEPS = 20
ORIGINS = 1_500


def normal_paths(spread: float, count: int, seed: int) -> Paths:
    """Speeds of 10 m/s plus one normal number for each path."""
    random = np.random.default_rng(seed)
    speed = 10.0 + spread * random.normal(size=(count, ORIGINS, 1)) * np.ones(STEPS + 1)
    speed[..., 0] = 10.0
    travelled = np.concatenate([np.zeros((count, ORIGINS, 1)), speed[..., 1:].cumsum(-1) * DT], -1)
    return Paths(torch.as_tensor(speed), torch.as_tensor(travelled))


def named_pairs(count: int) -> Any:
    """Returns pairs of which only the names and drivers are asked for."""
    names, drivers = [], []
    for number in range(count):
        names.append(f"p{number}")
        drivers.append(f"d{number}")
    return SimpleNamespace(ids=names, drivers=drivers)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """Of a calibrated method, of one that is too sure, and of one that gives a single path."""
    truth = normal_paths(1.0, 1, 0)
    happened = Recorded(
        speed=truth.speed[0].numpy(),
        travelled=truth.travelled[0].numpy(),
        gap=np.full(ORIGINS, 20.0),
        leader_speed=np.full((ORIGINS, STEPS + 1), 10.0),
        leader_travelled=np.tile(np.arange(STEPS + 1) * 1.0, (ORIGINS, 1)),
        exists=np.ones((ORIGINS, STEPS + 1), dtype=bool),
    )
    middle = normal_paths(0.0, 1, 0)
    paths = {
        "calibrated": normal_paths(1.0, 20, 1),
        "too sure": normal_paths(0.3, 20, 1),
        "single": Paths(middle.speed[0], middle.travelled[0]),
    }
    pairs = named_pairs(10)
    index = torch.arange(ORIGINS) % 10
    origins = Origins(index, torch.zeros_like(index))
    return score_distributions(pairs, origins, paths, happened, (1.0, 2.0), DT)


def test_a_horizon_that_no_recording_lasts_to_is_left_out() -> None:
    exists = np.ones((3, STEPS + 1), dtype=bool)
    exists[:, -1] = False
    still = np.zeros((3, STEPS + 1))
    happened = Recorded(
        speed=still,
        travelled=still,
        gap=np.full(3, 20.0),
        leader_speed=still,
        leader_travelled=still,
        exists=exists,
    )
    pairs = named_pairs(3)
    index = torch.arange(3)
    origins = Origins(index, torch.zeros_like(index))
    none = torch.zeros(20, 3, STEPS + 1)
    paths = {"sampled": Paths(none, none)}
    horizons = (1.0, STEPS * DT)
    found = score_distributions(pairs, origins, paths, happened, horizons, DT)
    assert found["horizon_s"].tolist() == [1.0] * 3


def mean_of(table: pd.DataFrame, method: str, column: str, horizon: float = 2.0) -> float:
    rows = table[(table["method"] == method) & (table["horizon_s"] == horizon)]
    return float(rows[column].mean())


def test_the_crps_is_that_of_the_normal_distribution(table: pd.DataFrame) -> None:
    """In closed form the mean CRPS of N(0, 1) under itself is 1 / sqrt(pi)."""
    assert mean_of(table, "calibrated", "crps_speed") == pytest.approx(np.pi**-0.5, rel=0.04)
    assert mean_of(table, "single", "crps_speed") == pytest.approx((2 / np.pi) ** 0.5, rel=0.04)
    assert mean_of(table, "calibrated", "crps_gap") == pytest.approx(2.0 * np.pi**-0.5, rel=0.04)


def test_a_calibrated_method_has_the_best_proper_scores(table: pd.DataFrame) -> None:
    for score in ("crps_speed", "crps_gap", "energy_speed"):
        best = mean_of(table, "calibrated", score)
        assert best < mean_of(table, "too sure", score)
        assert best < mean_of(table, "single", score)


def test_coverage_and_pit_say_who_is_calibrated(table: pd.DataFrame) -> None:
    assert mean_of(table, "calibrated", "coverage") == pytest.approx(0.9, abs=0.04)
    assert mean_of(table, "too sure", "coverage") < 0.5
    assert np.isnan(mean_of(table, "single", "coverage"))
    rows = table[(table["method"] == "calibrated") & (table["horizon_s"] == 1.0)]
    jitter = np.random.default_rng(0).uniform(0, 1 / 20, len(rows)) - 1 / 40
    assert stats.kstest(rows["pit"] + jitter, "uniform").statistic < 0.06
    sure = table[(table["method"] == "too sure") & (table["horizon_s"] == 1.0)]["pit"]
    assert ((sure < 0.05) | (sure > 0.95)).mean() > 0.4


def test_the_best_of_six_paths_is_nearer_than_one(table: pd.DataFrame) -> None:
    assert mean_of(table, "calibrated", "min_ade") < 0.5 * mean_of(table, "single", "min_ade")


def test_likelihoods_are_shares_and_higher_for_what_happens(table: pd.DataFrame) -> None:
    """A normal speed of standard deviation 1 in bins of 1 m/s."""
    for name in ("speed", "gap", "acceleration", "jerk", "time_to_collision"):
        assert table[f"likelihood_{name}"].between(0, 1).all()
    share = np.diff(stats.norm.cdf(np.arange(-5, 6)))
    found = mean_of(table, "calibrated", "likelihood_speed")
    assert found == pytest.approx(float((share**2).sum()), rel=0.1)
    assert mean_of(table, "calibrated", "likelihood_gap") > 0.2


def test_horizons_beyond_a_recording_are_left_out_and_drivers_count_alike(
    table: pd.DataFrame,
) -> None:
    assert tuple(table.columns) == DISTRIBUTION_COLUMNS
    assert len(table) == 3 * 2 * ORIGINS
    summary = summarize_distributions(table)
    assert len(summary) == 6
    metrics = distribution_metrics(table)
    key = "distribution/crps_speed_2s/calibrated"
    by_driver = table[(table["method"] == "calibrated") & (table["horizon_s"] == 2.0)]
    expected = by_driver.groupby("driver")["crps_speed"].mean().mean()
    assert metrics[key] == pytest.approx(expected)
    assert "distribution/coverage_2s/single" not in metrics
