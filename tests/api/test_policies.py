"""Policies from Python: the same bits as the command line, saved, tested and forecast with."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cfx
from cfx.errors import ConfigError, DataError
from tests.checkout import needs

RANDOM = {"optimizer": "random", "optimizer.samples": 64, "calibration.prior": "none"}
SMALL = {
    **RANDOM,
    "learner.epochs": 1,
    "learner.steps": 3,
    "learner.horizon": 6,
    "policy.hidden_size": 4,
    "protocol.folds": 2,
    "learner.ensemble_size": 1,
    "figures": "none",
}
QUIET = ["tracking.enabled=false", "figures=none", "cache.enabled=false"]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> cfx.Pairs:
    made = cfx.read(dataset="synthetic", pairs=4, frames=300)
    return made.save(tmp_path_factory.mktemp("recording") / "pairs.parquet")


@pytest.fixture(scope="module")
def others() -> cfx.Pairs:
    """Pairs that no policy here has learned from."""
    return cfx.read(dataset="synthetic", pairs=2, frames=300, seed=5)


@pytest.fixture(scope="module")
def trained(pairs: cfx.Pairs) -> cfx.plugin.Result:
    return cfx.train(pairs, "idm", for_="unseen_drivers", seed=2, **SMALL)


def same_metrics(one: dict[str, float], other: dict[str, float]) -> bool:
    """Says whether metrics are equal to the last bit, NaN included."""
    if one.keys() != other.keys():
        return False
    return all(other[k] == v or (math.isnan(v) and math.isnan(other[k])) for k, v in one.items())


def run(result: cfx.plugin.Result, folder: Path) -> cfx.plugin.Result:
    """Runs the command of a result."""
    command = cfx.from_config(result).command
    return cfx.run([*shlex.split(command)[3:], *QUIET, f"hydra.run.dir={folder}"])


def test_training_is_that_of_the_command_to_the_last_bit(
    trained: cfx.plugin.Result, tmp_path: Path
) -> None:
    assert "experiment=unseen_drivers" in cfx.from_config(trained).command
    assert same_metrics(trained.metrics, run(trained, tmp_path / "out").metrics)


def test_a_result_says_how_much_the_policy_improves(trained: cfx.plugin.Result) -> None:
    found = trained.improvement(over="pooled")
    assert found["geometric"] == trained.metrics["improvement/rmse_speed/pooled/geometric"]
    assert found["ci95_low"] <= found["geometric"] <= found["ci95_high"]
    with pytest.raises(DataError, match="known there: default, pooled, driver_specific"):
        trained.improvement(over="defaults")
    assert "rmse_speed" in trained._repr_html_()
    assert "not saved" in repr(trained)


def test_a_result_is_saved_loaded_tested_and_drawn(
    trained: cfx.plugin.Result, others: cfx.Pairs, tmp_path: Path
) -> None:
    saved = trained.save(tmp_path / "mine")
    again = cfx.load(saved.folder)
    assert same_metrics(trained.metrics, again.metrics)
    assert again.config == trained.config
    assert again.data == trained.data
    assert set(again.tables) == set(trained.tables)
    for name, table in trained.tables.items():
        pd.testing.assert_frame_equal(
            again.tables[name], table, check_dtype=False, check_exact=True
        )
    assert again.improvements == trained.improvements
    experiment = cfx.from_config(tmp_path / "mine")
    assert experiment.command == cfx.from_config(trained).command
    for result in (trained, again):
        assert vars(result.plot("drives"))["_repr_png_"]().startswith(b"\x89PNG")
    with pytest.raises(DataError, match="Did you mean 'drives'"):
        again.plot("drive")
    with pytest.raises(DataError, match="copy that folder"):
        again.save(tmp_path / "other")
    tested = cfx.evaluate(again, others, **RANDOM)
    in_memory = cfx.evaluate(trained, others, **RANDOM)
    assert same_metrics(tested.metrics, in_memory.metrics)
    assert same_metrics(tested.metrics, run(tested, tmp_path / "out").metrics)
    with pytest.raises(DataError, match="save it first"):
        _ = cfx.from_config(in_memory).command


def test_pairs_that_were_learned_from_are_refused(
    trained: cfx.plugin.Result, pairs: cfx.Pairs
) -> None:
    with pytest.raises(DataError, match=r"run=<in memory>: .* has learned from 4 of the 4 pairs"):
        cfx.evaluate(trained, pairs)
    with pytest.raises(DataError, match="has learned from 4 of the 4 pairs"):
        cfx.forecast(trained, pairs, at=10.0)


def test_a_forecast_reads_nothing_after_its_moment(others: cfx.Pairs) -> None:
    frame = others.frame
    after = frame["time_s"] > 10.0
    changed = frame.assign(follower_speed_mps=np.where(after, 3.0, frame["follower_speed_mps"]))
    settings = {"min_duration": 0, "accelerations": "recorded", "check": "off"}
    found = []
    for table in (frame, changed):
        read = cfx.read(table, **settings)
        found.append(cfx.forecast("cfx://idm", read, at=10.0, horizon=3.0))
    pd.testing.assert_frame_equal(found[0].paths, found[1].paths)
    first = found[0].paths.groupby("pair_id").first()
    assert (first["time_s"] == 10.0).all()
    assert (first["travelled"] == 0.0).all()
    assert found[0].paths.groupby("pair_id").size().tolist() == [31, 31]


@needs("cfx-forecasts")
def test_a_forecast_is_that_of_the_protocol_to_the_last_bit(others: cfx.Pairs) -> None:
    policy = "cfx://idm"
    settings = {"protocol.horizons": [2.0], "protocol.stride": 60.0}  # one moment
    result = cfx.evaluate(policy, others, protocol="forecast", **RANDOM, **settings)
    assert result.evaluation is not None
    errors = result.evaluation.tables["forecasts"].query("method == 'policy'")
    at = float(errors["history_s"].max())
    errors = errors[errors["history_s"] == at]
    future = cfx.forecast(policy, others, at=at, horizon=2.0)
    paths, measured = (one.set_index("pair_id") for one in (future.paths, future.measured))
    left = (paths["speed"] - measured["speed"]).groupby("pair_id").last()
    assert errors.set_index("pair_id")["speed_error"].to_dict() == left.to_dict()


def test_a_forecast_ends_where_what_is_given_ends(others: cfx.Pairs) -> None:
    given = cfx.forecast("cfx://idm", others, at=28.0, horizon=5.0)
    assert given.paths["time_s"].max() == pytest.approx(29.9)
    settings: dict[str, Any] = {"leader": "constant_speed", "at": 28.0, "horizon": 5.0}
    free = cfx.forecast("cfx://idm", others, **settings)
    assert free.paths["time_s"].max() == pytest.approx(33.0)
    assert free.measured["time_s"].max() == pytest.approx(29.9)


def test_sampled_paths_differ_by_seed_and_make_fans(others: cfx.Pairs) -> None:
    settings: dict[str, Any] = {"at": 10.0, "horizon": 2.0, "samples": 4}
    one, same, other = (
        cfx.forecast("cfx://idm-stochastic", others, seed=seed, **settings) for seed in (0, 0, 1)
    )
    pd.testing.assert_frame_equal(one.paths, same.paths)
    assert not one.paths.equals(other.paths)
    ends = one.paths[one.paths["time_s"] == one.paths["time_s"].max()]
    assert ends.groupby("pair_id")["speed"].nunique().tolist() == [4, 4]
    bands = one.quantiles((0.1, 0.9))["speed"]
    assert (bands.xs(0.1, level="quantile") <= bands.xs(0.9, level="quantile")).all()
    assert vars(one.plot())["_repr_png_"]().startswith(b"\x89PNG")


def test_a_forecast_refuses_what_it_cannot_do(others: cfx.Pairs) -> None:
    with pytest.raises(ConfigError, match="leaves nothing to chance"):
        cfx.forecast("cfx://idm", others, at=10.0, samples=5)
    with pytest.raises(ConfigError, match=r"pair .* lasts 29.9 s"):
        cfx.forecast("cfx://idm", others, at=40.0)
    with pytest.raises(ConfigError, match="at=nan: give a moment"):
        cfx.forecast("cfx://idm", others, at=float("nan"))
    with pytest.raises(ConfigError, match="horizon=10 s: give a duration in seconds"):
        cfx.forecast("cfx://idm", others, at=10.0, horizon="10 s")  # type: ignore[arg-type]  # what is tested
    for key in ("model", "policy.hidden_size", "windows"):
        with pytest.raises(ConfigError, match=f"{key}: the policy brings its model"):
            cfx.evaluate("cfx://idm", others, **{key: "krauss"})
    with pytest.raises(DataError, match="idn"):
        cfx.forecast("cfx://idn", others, at=10.0)
