"""The long table of values, and what is made of it: a row per pair, and a number per metric.

The long table has a row per pair, method, scope and metric: `pair_id`, `driver`, `method`, `scope`,
`metric`, `value`. The recorded drivers stand in it as the method `real`, with the metrics that say
something of a recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.calibration.identifiability import FLAT_SHARE_PREFIX
from cfx.evaluation.metrics.base import (
    RECORDED,
    RMSE_SPEED,
    SCOPES,
    MetricInfo,
    column_of,
    key_of,
)
from cfx.simulation.trajectory import TRANSIENT_S

VALUE_COLUMNS = ("pair_id", "driver", "method", "scope", "metric", "value")
"""Columns of the long table, which a job writes as `pair_metrics.parquet`."""

Floats = NDArray[np.float64]


def long_table(
    pair_ids: Sequence[str],
    drivers: Sequence[str],
    measured: Mapping[tuple[str, str, str], Floats],
) -> pd.DataFrame:
    """Returns the long table; its names are categories, which need little memory.

    Args:
        pair_ids, drivers: of P pairs.
        measured: by metric, scope and method the value of each pair, `(P,)`.
    """
    groups: dict[tuple[str, str], dict[str, Floats]] = {}
    for (metric, scope, method), values in measured.items():
        groups.setdefault((metric, scope), {})[method] = values
    keys = pd.MultiIndex.from_tuples(list(measured))
    metrics, scopes, methods = (keys.unique(level).tolist() for level in range(3))
    names = {"pair_id": list(pair_ids), "method": methods, "scope": scopes, "metric": metrics}
    codes: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    value = []
    for (metric, scope), by_method in groups.items():
        # Pair by pair, the methods in turn: in its last bit pandas' mean over groups depends on the
        # order.
        of_method = pd.Index(methods).get_indexer(pd.Index(list(by_method))).astype(np.int8)
        rows = len(pair_ids) * len(of_method)
        codes["pair_id"].append(np.arange(len(pair_ids), dtype=np.int32).repeat(len(of_method)))
        codes["method"].append(np.tile(of_method, len(pair_ids)))
        codes["scope"].append(np.full(rows, scopes.index(scope), np.int8))
        codes["metric"].append(np.full(rows, metrics.index(metric), np.int16))
        value.append(np.stack(list(by_method.values()), axis=1).reshape(-1))
    columns: dict[str, Any] = {}
    for name, categories in names.items():
        columns[name] = _categories(np.concatenate(codes.pop(name)), categories)
    of_pair, driver_names = pd.factorize(np.asarray(drivers, dtype=object))
    columns["driver"] = _categories(of_pair[columns["pair_id"].codes], list(driver_names))
    columns["value"] = np.concatenate(value)
    return pd.DataFrame({name: columns[name] for name in VALUE_COLUMNS})


def _categories(codes: NDArray[Any], names: list[str]) -> Any:
    """Returns a column of names; memory holds a small number for each."""
    return pd.Categorical.from_codes(codes, pd.Index(names))


def scope_label(scope: str, transient_s: float = TRANSIENT_S) -> str:
    """Returns how a part of trajectories is named: "test part after the first 5 s".

    Args:
        scope: one of `SCOPES`, or the name of another part, which is returned as it is.
        transient_s: length of the transient at the beginning of the test part, s.
    """
    if scope == "test":
        return "test part"
    if scope == "steady":
        return f"test part after the first {transient_s:g} s"
    if scope == "full_trajectory":
        return "full trajectories"
    return scope


def in_text(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns rows of the long table with their names as text, as they stand in the file."""
    texts = {}
    for name in VALUE_COLUMNS[:-1]:
        if isinstance(rows[name].dtype, pd.CategoricalDtype):
            texts[name] = rows[name].astype(rows[name].cat.categories.dtype)
    return rows.assign(**texts)


def values_of(values: pd.DataFrame, metric: str, scope: str) -> pd.DataFrame:
    """Returns one metric in one scope: a row per pair, in their order, and a column per method."""
    rows = values[(values["metric"] == metric) & (values["scope"] == scope)]
    row, pairs = pd.factorize(rows["pair_id"])
    column, methods = pd.factorize(rows["method"].astype(object), sort=True)
    wide = np.full((len(pairs), len(methods)), np.nan)
    wide[row, column] = rows["value"]
    index = pd.Index(list(pairs), name="pair_id")
    return pd.DataFrame(wide, index, pd.Index(list(methods), name="method"))


def wide_table(
    about: pd.DataFrame,
    values: pd.DataFrame,
    metrics: Sequence[MetricInfo],
    judge: str = RMSE_SPEED.name,
) -> pd.DataFrame:
    """Returns a row per pair and method: what `about` says, and the metrics as columns.

    Columns besides those of `about`: METRIC, `steady_METRIC`, `full_trajectory_METRIC` and, of the
    recorded driver, `real_METRIC`; `improvement_over_BASELINE`, of the metric `judge`.
    """
    is_parameter = about.columns.str.startswith(("parameter_", FLAT_SHARE_PREFIX))
    parameters = about.columns[is_parameter]
    columns: dict[str, pd.Series] = {}
    for scope in SCOPES:
        for metric in metrics:
            if scope in metric.scopes:
                column = at_places(values_of(values, metric.name, scope), about)
                if metric.summary == "sum":
                    column = _whole_numbers(column)
                columns[column_of(metric.name, scope)] = column
        if scope == "test":
            columns |= _improvements(about, values, judge)
    for metric in metrics:
        recorded = values_of(values, metric.name, "test")
        if RECORDED in recorded:
            columns[f"{RECORDED}_{metric.name}"] = about["pair_id"].map(recorded[RECORDED])
    first = about.drop(columns=parameters)
    return pd.concat([first, pd.DataFrame(columns, index=about.index), about[parameters]], axis=1)


def summaries(
    values: pd.DataFrame, metrics: Sequence[MetricInfo], scope: str, methods: Sequence[str]
) -> dict[str, float]:
    """Returns one number for each metric and method, under their names in `metrics.json`.

    Pairs whose value is not defined do not count.
    """
    by_key = {}
    for metric in metrics:
        rows = values[(values["metric"] == metric.name) & (values["scope"] == scope)]
        if scope not in metric.scopes or rows.empty:
            continue
        is_recorded = rows["method"] == RECORDED
        by_method = rows[~is_recorded].groupby("method", observed=True)["value"]
        if metric.summary == "sum":
            summary = by_method.sum(min_count=1)
        else:
            summary = by_method.agg(metric.summary)
        for method in methods:
            if method in summary:
                by_key[key_of(metric.name, method, scope)] = float(summary[method])
        recorded = rows.loc[is_recorded, "value"]
        if len(recorded):
            by_key[key_of(metric.name, RECORDED, scope)] = summarize(recorded, metric.summary)
    return by_key


def summarize(values: pd.Series, summary: str) -> float:
    """Returns the mean, sum, least or greatest of the defined values; NaN where none is."""
    if summary == "sum":
        return float(values.sum(min_count=1))
    return float(values.agg(summary))


def at_places(wide: pd.DataFrame, places: pd.DataFrame) -> pd.Series:
    """Returns the values that pairs and methods of a table have; NaN where it has none.

    Args:
        wide: a row per pair, a column per method.
        places: columns pair_id and method.
    """
    row = wide.index.get_indexer(pd.Index(places["pair_id"]))
    column = wide.columns.get_indexer(pd.Index(places["method"]))
    values_there = np.full(len(places), np.nan)
    present = (row >= 0) & (column >= 0)
    values_there[present] = wide.to_numpy(np.float64)[row[present], column[present]]
    return pd.Series(values_there, index=places.index)


def _whole_numbers(column: pd.Series) -> pd.Series:
    """Returns counts as whole numbers, where all are defined."""
    if bool(np.isfinite(column).all()) and not bool((column % 1).any()):
        return column.astype("int64")
    return column


def _improvements(about: pd.DataFrame, values: pd.DataFrame, judge: str) -> dict[str, pd.Series]:
    """Returns each method's improvement of an error over each baseline, by column."""
    errors = values_of(values, judge, "test")
    after = at_places(errors, about)
    columns = {}
    for baseline in about["method"].drop_duplicates():
        if baseline == "policy":
            continue
        before = about["pair_id"].map(errors[baseline])
        columns[f"improvement_over_{baseline}"] = ((before - after) / before).where(before > 0)
    return dict(sorted(columns.items()))
