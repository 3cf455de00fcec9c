"""The protocol `forecast`: what a job leaves of it, and what it refuses."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

import cfx
from cfx.errors import CfxError
from cfx_forecasts.errors import FORECAST_METHODS
from cfx_forecasts.tables import ForecastErrors
from tests.evaluation.protocols.test_across_drivers import QUICK

FORECAST = [
    *QUICK,
    "protocol=forecast",
    "protocol.folds=2",
    "protocol.horizons=[0.5,2]",
    "protocol.stride=0.5",
    "protocol.min_history=3",
    "protocol.histories=[]",
]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> cfx.plugin.Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("forecast"))
        return cfx.run([*FORECAST, "policy=fixed"])


def test_all_methods_are_forecast_from_the_same_origins(result: cfx.plugin.Result) -> None:
    table = pd.read_parquet(result.folder / "forecasts.parquet")
    methods = set(table["method"])
    assert methods <= set(FORECAST_METHODS)
    assert {
        "constant_speed",
        "constant_acceleration",
        "pooled",
        "driver_specific",
        "policy",
    } <= methods
    counts = table.value_counts(["method", "pair_id", "horizon_s"]).reset_index()
    per_forecast = counts.groupby(["pair_id", "horizon_s"])["count"]
    assert per_forecast.min().equals(per_forecast.max())
    assert table["history_s"].min() == 3.0
    notes = json.loads((result.folder / "data.json").read_text())["protocol"]["forecasts"]
    assert notes["leader"] == "given"
    assert notes["origins"]["0.5"] == len(table) / len(methods) - notes["origins"]["2"]


def test_forecasts_stand_in_every_table(result: cfx.plugin.Result) -> None:
    long = pd.read_parquet(result.folder / "pair_metrics.parquet")
    own = long[(long["scope"] == "forecast") & (long["metric"] == "rmse_speed_2s")]
    means = own.groupby("method")["value"].mean()
    for method in ("constant_speed", "driver_specific", "pooled"):
        # Each driver has one pair here, so the mean over pairs is that over drivers.
        key = f"forecast/rmse_speed_2s/{method}"
        assert result.metrics[key] == pytest.approx(means[method])
    wide = result.pairs[result.pairs["method"] == "driver_specific"].set_index("pair_id")
    rows = own[own["method"] == "driver_specific"].set_index("pair_id")["value"]
    pd.testing.assert_series_equal(
        wide["forecast_rmse_speed_2s"], rows, check_names=False, rtol=1e-9
    )
    console = Console(file=io.StringIO(), width=80)
    console.print(*ForecastErrors().console(result.evaluation, result.metrics))
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert f"{result.metrics['forecast/rmse_speed_0.5s/driver_specific']:.3f}" in shown
    assert "constant_acceleration" in shown


def test_pooled_parameters_as_policy_forecast_the_same(result: cfx.plugin.Result) -> None:
    for error in ("rmse_speed_0.5s", "fde_2s"):
        policy = result.metrics[f"forecast/{error}/policy"]
        assert policy == result.metrics[f"forecast/{error}/pooled"]


def test_driver_specific_parameters_read_nothing_after_the_first_origin(
    result: cfx.plugin.Result, monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    """Calibrated on three seconds they are not those of the closed-loop test, from 80 %."""
    table = pd.read_parquet(result.folder / "forecasts.parquet")
    monkeypatch.chdir(str(tmp_path))
    split = cfx.run([*FORECAST, "policy=fixed", "protocol.min_history=null"])
    later = pd.read_parquet(split.folder / "forecasts.parquet")
    both = ["method", "pair_id", "history_s", "horizon_s"]
    merged = table.merge(later, on=both, suffixes=("", "_split"))
    other = merged[merged["method"] == "driver_specific"]
    assert len(other)
    assert not other["speed_error"].equals(other["speed_error_split"])
    same = merged[merged["method"] == "pooled"]
    pd.testing.assert_series_equal(
        same["speed_error"], same["speed_error_split"], check_names=False
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["protocol.stride=0.25"], r"protocol.stride: 0.25 s is no whole number of steps of 0.1 s"),
        (["protocol.horizons=[-1]"], "horizons are seconds greater than 0"),
        (["protocol.horizons=[]"], "horizons"),
        (["protocol.min_history=500"], "no trajectory goes on for protocol.horizons"),
    ],
)
def test_what_cannot_be_is_refused(
    changes: list[str], message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.chdir(str(tmp_path))
    with pytest.raises(CfxError, match=message):
        cfx.run([*FORECAST, "policy=fixed", *changes])


def test_horizons_that_few_recordings_reach_are_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.INFO):
        result = cfx.run([*FORECAST, "policy=fixed", "protocol.horizons=[0.5,25]"])
    drivers = result.pairs["driver"].nunique()
    assert f"origins of {drivers} drivers" in caplog.text
    assert "(drivers that count): 25 s (0)." in caplog.text
    assert "forecast/rmse_speed_25s/policy" not in result.metrics


def test_sampled_paths_are_scored_as_distributions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of a stochastic policy and of constants with noise; single paths by their absolute error."""
    learner = ["learner=rollout", "learner.head=stochastic", "learner.epochs=1", "learner.steps=2"]
    small = ["learner.ensemble_size=1", "learner.horizon=4", "learner.compile=never"]
    small.append("protocol.stride=3")
    monkeypatch.chdir(tmp_path)
    result = cfx.run([*FORECAST, "policy=gru", "protocol.samples=6", *learner, *small])
    table = pd.read_parquet(result.folder / "distributions.parquet")
    single = pd.read_parquet(result.folder / "forecasts.parquet")
    sampled = {"policy", "pooled_ar", "driver_specific_ar"}
    assert sampled | set(single["method"]) == set(table["method"])
    covered = table.groupby("method")["coverage"].mean()
    assert covered[list(sampled)].between(0, 1).all()
    assert covered.drop(list(sampled)).isna().all()
    key = ["pair_id", "method", "horizon_s"]
    errors = single.assign(error=single["speed_error"].abs()).groupby(key)["error"].mean()
    scores = table.groupby(key)["crps_speed"].mean()
    for method in ("driver_specific", "driver_specific_residual", "constant_speed"):
        both = errors.xs(method, level="method"), scores.xs(method, level="method")
        pd.testing.assert_series_equal(*both, check_names=False, atol=1e-9)
    name = "distribution/crps_speed_0.5s/policy"
    by_driver = table[(table["method"] == "policy") & (table["horizon_s"] == 0.5)]
    expected = by_driver.groupby("driver")["crps_speed"].mean().mean()
    assert result.metrics[name] == pytest.approx(expected)
