"""The table of what a policy gains from known history."""

from __future__ import annotations

import numpy as np
import pandas as pd

from cfx.evaluation.result import Evaluation
from cfx.evaluation.statistics import improvement_statistics
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import DRIVER, PAIR


class History(ResultTable):
    """What the policy gains from its burn-in, a row per pair, base and amount of history."""

    meaning = "the improvement for different lengths of known history"
    order = 110
    columns = (
        PAIR,
        DRIVER,
        Column("base", "", "what the policy's answers are offsets from", "text"),
        Column("history_s", "s", "measured history before the test part that it has seen"),
        Column("amount", "", "the same in words, `10 s` or `80 %`", "text"),
        Column("rmse_speed", "m/s", "RMSE of speed on the test part"),
        Column("rmse_gap", "m", "RMSE of the gap on the test part"),
        Column("improvement", "1", "over driver-specific parameters"),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return history_metrics(evaluation.tables["history"])


def history_metrics(history: pd.DataFrame) -> dict[str, float]:
    """Return `history/BASE/AMOUNT/improvement`, geometric over drivers.

    AMOUNT is `80pct` for "80 %" and `10s` for "10 s".
    """
    values = {}
    for (base, amount), rows in history.groupby(["base", "amount"]):
        name = str(amount).replace(" ", "").replace("%", "pct")
        ratios = 1.0 - rows["improvement"].to_numpy(float)
        improvement = improvement_statistics(np.ones_like(ratios), ratios, rows["driver"].tolist())
        values[f"history/{base}/{name}/improvement"] = improvement.geometric
    return values
