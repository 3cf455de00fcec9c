"""Errors of forecasts: at each origin, over origins of a driver, over drivers.

Origins of one driver overlap, and are never counted as independent: errors are the RMSE over the
origins of a driver, then the mean over drivers, with the interval over drivers.

Shapes: Q origins, K steps, H horizons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from torch import Tensor

from cfx.data.pairs import PairSet
from cfx.evaluation.distributions import distribution_metrics
from cfx.evaluation.forecast_paths import Origins, Paths
from cfx.evaluation.statistics import mean_interval

FORECAST_METHODS = (
    "constant_speed",
    "constant_acceleration",
    "default",
    "population",
    "population_residual",
    "fixed",
    "fixed_residual",
    "policy",
)
"""What forecasts compare, in the order in which it is shown."""

SCOPE = "forecast"
"""The scope of forecasts in the long table, and what their metrics begin with."""

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
"""Columns of the table of single forecasts, which a job writes as `forecasts.parquet`."""


@dataclass(frozen=True)
class Forecasts:
    """Forecasts of several methods from the same origins.

    Metrics (`metrics`), under their names in metrics.json and MLflow:
        `forecast/ERROR_HORIZON/METHOD`, such as `forecast/rmse_speed_0.5s/policy`: the mean over
        drivers; ERROR is one of `ERRORS`. `forecast/ERROR_HORIZON/METHOD/ci95_low` and `ci95_high`:
        its 95 % bootstrap interval over drivers, of `rmse_speed` and `rmse_position`.

    Attributes:
        table: a row per origin, method and horizon that the recording lasts to (columns
            `FORECAST_COLUMNS`): history_s (s of measured history up to the origin), speed_error
            (m/s) and position_error (m), simulated minus measured at the horizon, ade (m).
        horizons: s.
        leader: what was known of the leader (`LeaderFuture`).
        seed: of the bootstrap.
        distributions: scores of sampled paths (`cfx.evaluation.distributions`); None: none were
            sampled. Their metrics are `distribution/SCORE_HORIZON/METHOD`, means over drivers.
    """

    table: pd.DataFrame
    horizons: tuple[float, ...]
    leader: str
    seed: int
    distributions: pd.DataFrame | None = None

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, known ones in the order of `FORECAST_METHODS`."""
        return forecast_methods(self.table)

    @cached_property
    def by_pair(self) -> pd.DataFrame:
        """A row per pair, method and horizon with a column per error."""
        return errors_by(self.table, ["pair_id", "driver", "method", "horizon_s"])

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row per method and horizon; see `summarize_forecasts`."""
        return summarize_forecasts(self.table, self.seed)

    @property
    def varies_history(self) -> bool:
        """Whether origins have so different histories that errors can be told apart by them."""
        return len(set(errors_by_history(self.table)["span_s"])) > 1

    def values(self) -> pd.DataFrame:
        """Returns rows of the long table: pair_id, driver, method, scope, metric, value."""
        by_pair = self.by_pair
        parts = []
        for error in ERRORS:
            metric = [metric_name(error, horizon) for horizon in by_pair["horizon_s"]]
            part = by_pair[["pair_id", "driver", "method"]].assign(
                scope=SCOPE, metric=metric, value=by_pair[error].to_numpy()
            )
            parts.append(part)
        return pd.concat(parts, ignore_index=True)

    def columns(self, places: pd.MultiIndex) -> dict[str, pd.Series]:
        """Returns the columns `forecast_METRIC` of `pairs.csv`.

        Args:
            places: pair and method of each row.
        """
        values = self.values()
        found = {}
        for metric, rows in values.groupby("metric", sort=False):
            column = rows.set_index(["pair_id", "method"])["value"]
            found[f"{SCOPE}_{metric}"] = column.reindex(places).reset_index(drop=True)
        return found

    def metrics(self) -> dict[str, float]:
        """Returns the metrics under their MLflow names."""
        found = {}
        for row in self.summary.to_dict("records"):
            for error in ERRORS:
                key = f"{SCOPE}/{metric_name(error, row['horizon_s'])}/{row['method']}"
                found[key] = float(row[error])
                for end in ("low", "high"):
                    if error in _QUADRATIC:
                        found[f"{key}/ci95_{end}"] = float(row[f"{error}_{end}"])
        if self.distributions is not None:
            found |= distribution_metrics(self.distributions)
        return found


def metric_name(error: str, horizon: float) -> str:
    """Returns the name of an error at a horizon in s, such as `rmse_speed_0.5s`."""
    return f"{error}_{horizon:g}s"


def forecast_methods(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns the methods of a table of forecasts in the order in which they are shown."""
    present = table["method"].astype(str).unique().tolist()
    known = [method for method in FORECAST_METHODS if method in present]
    return (*known, *(method for method in present if method not in known))


def forecast_errors(
    pairs: PairSet,
    origins: Origins,
    paths: Mapping[str, Paths],
    measured: Paths,
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
        The table of `Forecasts`.
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
    found = grouped[list(ERRORS)].mean()
    for error in _QUADRATIC:
        found[error] = np.sqrt(found[error])
    found["origins"] = grouped.size()
    return found.reset_index()


def summarize_forecasts(table: pd.DataFrame, seed: int, by: str = "horizon_s") -> pd.DataFrame:
    """Returns the mean over drivers of the errors over each driver's origins.

    Args:
        table: of single forecasts.
        seed: of the bootstrap.
        by: column that tells the forecasts of a method from one another.

    Returns:
        A row per method and value of `by`, with columns for each error; `rmse_speed_low`,
        `rmse_speed_high`, `rmse_position_low` and `rmse_position_high`, the 95 % bootstrap interval
        over drivers; drivers and origins, how many there are.
    """
    rows = []
    of_driver = errors_by(table, ["method", by, "driver"])
    for (method, value), found in of_driver.groupby(["method", by], sort=False, observed=True):
        row: dict[str, object] = {"method": method, by: value}
        row |= {error: float(found[error].mean()) for error in ERRORS}
        drivers = found["driver"].astype(str).tolist()
        for error in _QUADRATIC:
            _, low, high = mean_interval(found[error].tolist(), drivers, seed=seed)
            row |= {f"{error}_low": low, f"{error}_high": high}
        row |= {"drivers": len(found), "origins": int(found["origins"].sum())}
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
    found = grouped[list(ERRORS)].mean()
    found["drivers"] = grouped.size()
    found = found.reset_index().sort_values("span_s", kind="stable")
    enough = found["drivers"] >= 0.5 * table["driver"].nunique()
    return found[enough].reset_index(drop=True)


def _array(values: Tensor) -> np.ndarray:
    return np.asarray(values.double().cpu().numpy())
