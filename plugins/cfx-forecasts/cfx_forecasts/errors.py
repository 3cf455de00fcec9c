"""Errors of forecasts: the RMSE over a driver's origins, then the mean over drivers.

Origins of one driver overlap, and are never counted as independent: intervals are over drivers.

Shapes: Q origins, K simulated steps, H horizons. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.plugin import FORECAST, PairBatch, PairSet, forecasts, statistics

SCOPE = FORECAST
"""The scope of forecasts in the long table, and what their metrics begin with."""

FORECAST_METHODS = (
    "constant_speed",
    "constant_acceleration",
    "default",
    "pooled",
    "pooled_residual",
    "driver_specific",
    "driver_specific_residual",
    "policy",
)
"""What forecasts compare, in the order in which it is shown."""

ERRORS = {
    "rmse_speed": ("m/s", "RMSE of speed at the horizon"),
    "rmse_position": ("m", "RMSE of position at the horizon"),
    "ade": ("m", "absolute error of position, mean over the way to the horizon"),
    "fde": ("m", "absolute error of position at the horizon"),
}
"""Errors of a forecast by name: unit and meaning."""


_QUADRATIC = {"rmse_speed": "speed_error", "rmse_position": "position_error"}


_SPANS = 6
"""Most spans of history that errors are told apart by."""


FORECAST_COLUMNS = (
    "pair_id",
    "driver",
    "method",
    "history_s",
    "horizon_s",
    "speed_error",
    "position_error",
    "ade",
)
"""Columns of the table of single forecasts, which a job writes as `forecasts.parquet`.

It has a row per origin, method and horizon that the recording lasts to. history_s: measured history
up to the origin; speed_error (m/s) and position_error (m): simulated minus measured at the horizon;
ade: m.
"""


def forecast_values(table: pd.DataFrame) -> pd.DataFrame:
    """Returns rows of the long table: pair_id, driver, method, scope, metric, value.

    Args:
        table: of single forecasts.
    """
    by_pair = errors_by(table, ["pair_id", "driver", "method", "horizon_s"])
    parts = []
    for error in ERRORS:
        metric = [metric_name(error, horizon) for horizon in by_pair["horizon_s"]]
        part = by_pair[["pair_id", "driver", "method"]].assign(
            scope=SCOPE, metric=metric, value=by_pair[error].to_numpy()
        )
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def forecast_metrics(table: pd.DataFrame) -> dict[str, float]:
    """Returns the metrics of forecasts under their names in metrics.json and MLflow.

    `forecast/ERROR_HORIZON/METHOD`, such as `forecast/rmse_speed_0.5s/policy`, is the mean over
    drivers; ERROR is one of `ERRORS`. `forecast/ERROR_HORIZON/METHOD/ci95_low` and `ci95_high` are
    its 95 % interval over drivers, of `rmse_speed` and `rmse_position`.

    Args:
        table: of single forecasts.
    """
    metrics = {}
    for row in summarize_forecasts(table).to_dict("records"):
        for error in ERRORS:
            key = f"{SCOPE}/{metric_name(error, row['horizon_s'])}/{row['method']}"
            metrics[key] = float(row[error])
            for end in ("low", "high"):
                if error in _QUADRATIC:
                    metrics[f"{key}/ci95_{end}"] = float(row[f"{error}_{end}"])
    return metrics


def metric_name(error: str, horizon: float) -> str:
    """Returns the name of an error at a horizon in s, such as `rmse_speed_0.5s`."""
    return f"{error}_{horizon:g}s"


def forecast_methods(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns the methods of a table of forecasts in the order in which they are shown."""
    present = table["method"].astype(str).unique().tolist()
    ordered = [method for method in FORECAST_METHODS if method in present]
    return (*ordered, *(method for method in present if method not in ordered))


def forecast_errors(
    pairs: PairSet,
    origins: forecasts.Origins,
    paths: Mapping[str, forecasts.Paths],
    measured: forecasts.Paths,
    recorded: Tensor,
    horizons: Sequence[float],
    dt: float,
) -> pd.DataFrame:
    """Compares forecasts with what was measured.

    Args:
        pairs: P pairs.
        origins: Q of them.
        paths: by method.
        measured: what the followers did.
        recorded: which frames of it there are, bool `(Q, K + 1)`.
        horizons: s.
        dt: time step, s.

    Returns:
        A table with `FORECAST_COLUMNS`.
    """
    first, frame = origins.columns(pairs), origins.frame.cpu().numpy()
    parts = []
    for method, path in paths.items():
        off = path.travelled - measured.travelled
        so_far = off[:, 1:].abs().cumsum(1)
        for horizon in horizons:
            step = round(horizon / dt)
            exists = recorded[:, step].cpu().numpy()
            columns = {
                **first,
                "method": method,
                "history_s": frame * dt,
                "horizon_s": float(horizon),
                "speed_error": _array(path.speed[:, step] - measured.speed[:, step]),
                "position_error": _array(off[:, step]),
                "ade": _array(so_far[:, step - 1] / step),
            }
            parts.append(pd.DataFrame(columns)[exists])
    table = pd.concat(parts, ignore_index=True)
    return table[list(FORECAST_COLUMNS)]


def errors_by(table: pd.DataFrame, groups: Sequence[str]) -> pd.DataFrame:
    """Returns a row per group with a column per error and `origins`, how many there are.

    Args:
        table: of single forecasts.
        groups: columns whose values make a group.
    """
    squares = table.assign(
        rmse_speed=table["speed_error"] ** 2,
        rmse_position=table["position_error"] ** 2,
        fde=table["position_error"].abs(),
    )
    grouped = squares.groupby(list(groups), sort=False, observed=True)
    means = grouped[list(ERRORS)].mean()
    for error in _QUADRATIC:
        means[error] = np.sqrt(means[error])
    means["origins"] = grouped.size()
    return means.reset_index()


def summarize_forecasts(table: pd.DataFrame, by: str = "horizon_s") -> pd.DataFrame:
    """Returns the mean over drivers of the errors over each driver's origins.

    Args:
        table: of single forecasts.
        by: column that tells the forecasts of a method from one another.

    Returns:
        A row per method and value of `by`, with columns for each error; `rmse_speed_low`,
        `rmse_speed_high`, `rmse_position_low` and `rmse_position_high`, the 95 % interval
        over drivers; drivers and origins, how many there are.
    """
    rows = []
    of_driver = errors_by(table, ["method", by, "driver"])
    for (method, value), errors in of_driver.groupby(["method", by], sort=False, observed=True):
        row: dict[str, object] = {"method": method, by: value}
        row |= {error: float(errors[error].mean()) for error in ERRORS}
        drivers = errors["driver"].astype(str).tolist()
        for error in _QUADRATIC:
            _, low, high = statistics.mean_interval(errors[error].tolist(), drivers)
            row |= {f"{error}_low": low, f"{error}_high": high}
        row |= {"drivers": len(errors), "origins": int(errors["origins"].sum())}
        rows.append(row)
    return pd.DataFrame(rows)


def errors_by_history(table: pd.DataFrame) -> pd.DataFrame:
    """Returns errors by how much of a driver had been measured up to the origin.

    Histories are cut into spans of whole seconds, six of them up to the longest history that half
    of the drivers have. A span counts if half of the drivers have origins in it, so that none is of
    few drivers only.

    Args:
        table: of single forecasts.

    Returns:
        A row per method, horizon and span: method, horizon_s, span_s (its middle), a column for
        each error (mean over drivers), drivers.
    """
    history = table["history_s"]
    first = float(history.min())
    last = float(table.groupby("driver")["history_s"].max().median())
    width = max(1.0, float(np.ceil((last - first) / _SPANS)))
    middle = first + width * (np.floor((history - first) / width) + 0.5)
    groups = ["method", "horizon_s", "span_s", "driver"]
    of_driver = errors_by(table.assign(span_s=middle), groups)
    grouped = of_driver.groupby(groups[:-1], sort=False, observed=True)
    means = grouped[list(ERRORS)].mean()
    means["drivers"] = grouped.size()
    means = means.reset_index().sort_values("span_s", kind="stable")
    enough = means["drivers"] >= 0.5 * table["driver"].nunique()
    return means[enough].reset_index(drop=True)


def _array(values: Tensor) -> np.ndarray:
    return np.asarray(values.double().cpu().numpy())


def kinematic_paths(
    batch: PairBatch, origins: forecasts.Origins, steps: int, *, accelerates: bool
) -> forecasts.Paths:
    """Returns followers that go on as they do at the origin: at constant speed or acceleration.

    Nobody drives backwards: who brakes, stops.

    Args:
        batch: P pairs.
        origins: Q of them.
        steps: K.
        accelerates: the acceleration is constant, not the speed.
    """
    speed = batch.follower_speed[origins.pair, origins.frame]
    acceleration = torch.zeros_like(speed)
    if accelerates:
        acceleration = batch.follower_acceleration[origins.pair, origins.frame]
    return forecasts.extrapolated(speed, acceleration, steps, batch.dt)
