"""The scikit-learn estimator: its conventions, and the calibration behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import polars
import pyarrow as pa
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.utils import estimator_checks

import cfx
from cfx.errors import ConfigError, DataError
from cfx.sklearn import CarFollowingRegressor

CHECKS = (
    "check_do_not_raise_errors_in_init_or_set_params",
    "check_mixin_order",
    "check_estimator_cloneable",
    "check_estimator_repr",
    "check_estimator_tags_renamed",
    "check_get_params_invariance",
    "check_no_attributes_set_in_init",
    "check_parameters_default_constructible",
    "check_set_params",
    "check_valid_tag_types",
)
"""Those that feed no arrays of random numbers."""


SETTINGS = {"optimizer": "random", "optimizer.samples": 64, "calibration.prior": "weak"}


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return cfx.read(dataset="synthetic", pairs=3, frames=150).frame


@pytest.fixture(scope="module")
def fitted(table: pd.DataFrame) -> CarFollowingRegressor:
    return CarFollowingRegressor("idm", settings=SETTINGS).fit(table)


@pytest.mark.parametrize("name", CHECKS)
def test_it_keeps_the_conventions(name: str) -> None:
    getattr(estimator_checks, name)("CarFollowingRegressor", CarFollowingRegressor())


def test_speeds_are_predicted_in_the_order_of_the_rows(
    fitted: CarFollowingRegressor, table: pd.DataFrame
) -> None:
    predicted = fitted.predict(table)
    assert np.isfinite(predicted).all()
    shuffled = table.sample(frac=1.0, random_state=1)
    again = pd.Series(fitted.predict(shuffled), shuffled.index).sort_index()
    np.testing.assert_array_equal(again, predicted)
    first = table["frame"] == 0
    np.testing.assert_array_equal(predicted[first], table.loc[first, "follower_speed_mps"])


def test_rows_are_matched_however_pairs_and_times_are_written(
    fitted: CarFollowingRegressor, table: pd.DataFrame
) -> None:
    predicted = fitted.predict(table)
    numbers = pd.Series(pd.factorize(table["pair_id"])[0], table.index)
    for ids in (numbers.astype(float), numbers.astype(str) + " "):
        again = table.assign(pair_id=ids).drop(columns="frame")
        np.testing.assert_array_equal(fitted.predict(again), predicted)


def test_tables_of_other_libraries_are_tables_too(
    fitted: CarFollowingRegressor, table: pd.DataFrame
) -> None:
    predicted, score = fitted.predict(table), fitted.score(table)
    for other in (polars.from_pandas(table), pa.Table.from_pandas(table), dict(table.items())):
        np.testing.assert_array_equal(fitted.predict(other), predicted)
        assert fitted.score(other) == score
    frame = polars.from_pandas(table)
    again = CarFollowingRegressor("idm", settings=SETTINGS).fit(frame)
    assert again.parameters_.equals(fitted.parameters_)
    assert again.feature_names_in_.tolist() == frame.columns
    scores = cross_val_score(again, frame, cv=GroupKFold(2), groups=table["pair_id"].to_numpy())
    assert np.isfinite(scores).all()


def test_its_score_is_the_loss_of_its_parameters(
    fitted: CarFollowingRegressor, table: pd.DataFrame
) -> None:
    errors = (fitted.predict(table) - table["follower_speed_mps"]) ** 2
    compared = table["frame"] > 0
    losses = errors[compared].groupby(table["pair_id"]).mean() ** 0.5
    assert fitted.score(table) == pytest.approx(-losses.mean(), rel=1e-9)
    assert list(fitted.parameters_.index) == ["v0", "T", "s0", "a", "b"]


def test_drivers_are_held_out_together(table: pd.DataFrame) -> None:
    regressor = CarFollowingRegressor("idm", settings=SETTINGS)
    scores = cross_val_score(regressor, table, groups=table["pair_id"], cv=GroupKFold(3))
    assert scores.shape == (3,)
    assert (scores < 0).all()


def test_what_is_no_table_is_refused(table: pd.DataFrame) -> None:
    with pytest.raises(NotFittedError):
        CarFollowingRegressor().predict(table)
    given: Any = np.zeros((4, 3))
    with pytest.raises(DataError, match="X: an array has no names of columns"):
        CarFollowingRegressor().fit(given)
    with pytest.raises(ConfigError, match="there is no model 'idn'"):
        CarFollowingRegressor("idn").fit(table)
