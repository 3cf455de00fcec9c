"""Tables of what was measured of each pair."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from cfx.calibration.identifiability import flat_for
from cfx.evaluation.result import Evaluation
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import DRIVER, METHOD, PAIR


class Pairs(ResultTable):
    """A row per pair and method: the metrics of the test part and beyond, and the parameters."""

    meaning = "a row per pair and method"
    suffix = ".csv"
    tracked = "table"
    order = 10
    always = True
    columns = (
        PAIR,
        Column("recording", "", "the recording that the pair is of", "text", required=False),
        Column("leader_id", "", "the leader, as the recording names it", "text", required=False),
        Column("follower_id", "", "the follower, likewise", "text", required=False),
        DRIVER,
        Column("cluster", "", "the cluster of the driver's style, by name", "text"),
        Column("style_score", "1", "the driver's style", required=False),
        Column("fold", "1", "which fold tested the driver", "int", required=False),
        METHOD,
        Column("frames", "1", "frames that count", "int"),
        Column("rmse_speed", "m/s", "RMSE of speed on the test part"),
        Column("rmse_gap", "m", "RMSE of the gap on the test part"),
        Column("collisions", "1", "1 if the gap became negative", "int"),
        Column("METRIC", "as of the metric", "another metric of the test part"),
        Column("improvement_over_METHOD", "1", "improvement over a method, of the job's error"),
        Column("steady_METRIC", "as of the metric", "a metric after the transient"),
        Column("full_trajectory_METRIC", "as of the metric", "a metric of the full trajectory"),
        Column("real_METRIC", "as of the metric", "a metric of the recorded driver"),
        Column("parameter_NAME", "as of the parameter", "mean of a parameter over the frames"),
        Column(
            "flat_NAME",
            "1",
            "of driver-specific parameters: on which share of the range the loss is within 5 %"
            " of its best; 1: the recording does not determine it",
        ),
        Column("forecast_METRIC", "as of the metric", "an error of the pair's forecasts"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [evaluation.table]

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        shares = flat_for(evaluation.table, evaluation.names)
        return {f"flat/{name}": share for name, share in shares.items()}


class PairMetrics(ResultTable):
    """Every metric of every pair, method and part of the trajectories."""

    meaning = "a row per pair, method, scope and metric: what the tables are made from"
    order = 20
    large = True
    columns = (
        PAIR,
        Column("driver", "", "the follower of the pair", "text", required=False),
        Column("method", "", "what drove; `real` is the recorded driver", "text"),
        Column("scope", "", "the part of the trajectory", "text"),
        Column("metric", "", "the name of the metric", "text"),
        Column("value", "as of the metric", "NaN where it is not defined"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return evaluation.values_tables()
