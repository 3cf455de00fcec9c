"""The table of what drivers' pasts say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import pandas as pd

from cfx.evaluation.result import Evaluation
from cfx.policies.context import LEVEL as EXPECTED_LEVEL
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import DRIVER, PAIR

_UNLIKE = 3.0
"""Standard deviations from which on a driver is unlike those that were learned from."""

_FEW = 0.1
"""Share of such drivers that is not worth a word; of those learned from it is 0.01 to 0.04."""

_WORSE = 1.1
"""From this ratio of errors on, the policy is said to be worse than driver-specific parameters."""


class Past(ResultTable):
    """What each driver's past says of the policy and of driver-specific parameters.

    METHOD is `driver_specific`; `alone`, the policy alone; or `policy`, as it was tested: beside
    driver-specific parameters, if it combines.
    """

    meaning = "what each driver's past says of the policy (`protocol.combine`, `protocol=transfer`)"
    suffix = ".csv"
    order = 115
    always_printed = True
    columns = (
        PAIR,
        DRIVER,
        Column("share", "1", "the policy's share of the acceleration in the test part"),
        Column(
            "past_rmse_speed_METHOD",
            "m/s",
            "RMSE of speed over the last 40 % of the past, of which nothing was known; of `policy`"
            " that of the mean of both simulations",
        ),
        Column("rmse_speed_METHOD", "m/s", "RMSE of speed over the test part"),
        Column(
            "bound_METHOD",
            "m/s",
            f"what {EXPECTED_LEVEL:.0%} of drivers' RMSE of speed is expected below",
        ),
        Column(
            "unlike",
            "1",
            "how far the driver is from those that the policy learned from: the driver feature that"
            " is furthest from their mean, in standard deviations",
            required=False,
        ),
        Column("unlike_in", "", "which driver feature that is", "text", required=False),
    )

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        table = evaluation.tables["past"]
        metrics = {
            "past/share": float(table["share"].mean()),
            "past/rmse_speed/alone": float(table["rmse_speed_alone"].mean()),
            "past/ratio/alone": _ratio(table["past_rmse_speed_alone"], table),
        }
        for method in ("policy", "driver_specific"):
            bound = table[f"bound_{method}"].dropna()
            if len(bound):
                below = table.loc[bound.index, f"rmse_speed_{method}"] <= bound
                metrics[f"past/bound/{method}"] = float(bound.mean())
                metrics[f"past/coverage/{method}"] = float(below.mean())
        if "unlike" in table and table["unlike"].notna().any():
            metrics["past/unlike"] = float((table["unlike"].dropna() > _UNLIKE).mean())
        return metrics

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[str]:
        """Returns how the two drove together, what error to expect, and a warning."""
        table = evaluation.tables["past"]
        if float(table["share"].min()) < 1:
            yield (
                "The policy drives beside driver-specific parameters, with a share of"
                f" {metrics['past/share']:.2f} on average, as their errors in the driver's past"
                f" give it; alone its RMSE of speed is {metrics['past/rmse_speed/alone']:.3f} m/s."
            )
        if "past/bound/policy" in metrics:
            yield (
                f"Expected of {EXPECTED_LEVEL:.0%} of drivers, from their past: RMSE of speed below"
                f" {metrics['past/bound/policy']:.3f} m/s (driver-specific parameters alone"
                f" {metrics['past/bound/driver_specific']:.3f} m/s); so it is for"
                f" {metrics['past/coverage/policy']:.0%} of them (bound_policy in past.csv)."
            )
        if metrics.get("past/unlike", 0.0) > _FEW:
            unlike = table[table["unlike"] > _UNLIKE]
            most = str(unlike["unlike_in"].mode()[0]).replace("_", " ")
            yield (
                f"[yellow]{len(unlike)} of {table['unlike'].notna().sum()} drivers drive unlike"
                f" those that it learned from, most often in their {most} (unlike in past.csv)."
            )
        ratio = _ratio(table["past_rmse_speed_alone"], table)
        if ratio > _WORSE:
            yield (
                f"[yellow]Expect {ratio:.1f} times the error of driver-specific parameters from"
                " this policy alone: it learned from no drivers like these. Train on recordings"
                " like this one."
            )


def _ratio(error: pd.Series, table: pd.DataFrame) -> float:
    """Returns the median ratio of an error in the past to that of driver-specific parameters."""
    baseline = table["past_rmse_speed_driver_specific"]
    ratio = (error / baseline.where(baseline > 0)).dropna()
    return float(ratio.median()) if len(ratio) else math.nan
