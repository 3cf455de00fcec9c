"""The tables that one evaluation is written as."""

from __future__ import annotations

import numpy as np
import pandas as pd

from cfx.evaluation.metrics.base import MetricInfo
from cfx.evaluation.tables import long_table, wide_table


def info(name: str, summary: str) -> MetricInfo:
    return MetricInfo(name, "", "lower", summary, name, "", ("test",), False, "cfx")


def test_counts_are_whole_numbers_and_means_are_not_rounded_or_retyped() -> None:
    metrics = [info("rmse_speed", "mean"), info("collisions", "sum"), info("braking", "sum")]
    measured = {
        ("rmse_speed", "test", "policy"): np.array([1.0, 2.0]),
        ("collisions", "test", "policy"): np.array([0.0, 1.0]),
        ("braking", "test", "policy"): np.array([3.0, np.nan]),
    }
    values = long_table(["a", "b"], ["one", "two"], measured)
    about = pd.DataFrame({"pair_id": ["a", "b"], "method": "policy"})
    table = wide_table(about, values, metrics)
    assert table["rmse_speed"].dtype == np.float64
    assert table["collisions"].dtype == np.int64
    assert table["braking"].dtype == np.float64  # one pair has none
    assert table["collisions"].tolist() == [0, 1]
