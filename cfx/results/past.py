"""The table of what drivers' pasts say of a policy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import pandas as pd

from cfx.policies.expected_error import LEVEL
from cfx.results.table import Column, Findings, ResultTable

_WORSE = 1.1
"""From this ratio of errors on, the policy is said to be worse than drivers' own parameters."""


class Past(ResultTable):
    """What each driver's past says of the policy and of their own parameters, and what came of it.

    METHOD is `fixed`, the driver's own parameters (in the past they start, as the policy does, with
    the driver's acceleration); `alone`, the policy alone; or `policy`, as it was tested: beside the
    driver's own parameters.
    """

    meaning = "what each driver's past says of the policy (`protocol.combine`)"
    suffix = ".csv"
    order = 115
    columns = (
        Column("pair_id", "", "the pair of leader and follower", "text"),
        Column("driver", "", "the follower of the pair", "text"),
        Column("share", "1", "the policy's share of the acceleration in the test part"),
        Column(
            "past_rmse_speed_METHOD",
            "m/s",
            "RMSE of speed over the last 40 % of the past, of which nothing was known; of `policy`"
            " if the two errors are independent",
        ),
        Column("rmse_speed_METHOD", "m/s", "RMSE of speed over the test part"),
        Column(
            "bound_METHOD", "m/s", f"what {LEVEL:.0%} of drivers' RMSE of speed is expected below"
        ),
    )

    def metrics(self, findings: Findings) -> Mapping[str, float]:
        table = findings.evaluation.tables["past"]
        found = {
            "past/share": float(table["share"].mean()),
            "past/rmse_speed/alone": float(table["rmse_speed_alone"].mean()),
            "past/ratio/alone": _ratio(table["past_rmse_speed_alone"], table),
        }
        for method in ("policy", "fixed"):
            bound = table[f"bound_{method}"].dropna()
            if len(bound):
                below = table.loc[bound.index, f"rmse_speed_{method}"] <= bound
                found[f"past/bound/{method}"] = float(bound.mean())
                found[f"past/coverage/{method}"] = float(below.mean())
        return found

    def console(self, findings: Findings, metrics: Mapping[str, float]) -> Iterable[str]:
        """Returns how the two drove together, what error to expect, and a warning."""
        table = findings.evaluation.tables["past"]
        yield (
            "The policy drives beside each driver's own parameters, with a share of"
            f" {metrics['past/share']:.2f} on average, as their errors in the driver's past give"
            f" it; alone its RMSE of speed is {metrics['past/rmse_speed/alone']:.3f} m/s."
        )
        if "past/bound/policy" in metrics:
            yield (
                f"Expected of {LEVEL:.0%} of drivers, from their past: RMSE of speed below"
                f" {metrics['past/bound/policy']:.3f} m/s (own parameters alone"
                f" {metrics['past/bound/fixed']:.3f} m/s); so it is for"
                f" {metrics['past/coverage/policy']:.0%} of them (bound_policy in past.csv)."
            )
        ratio = _ratio(table["past_rmse_speed_alone"], table)
        if ratio > _WORSE:
            yield (
                f"[yellow]Expect {ratio:.1f} times the error of constant parameters from this"
                " policy alone: it learned from no drivers like these. Train on recordings like"
                " this one."
            )


def _ratio(error: pd.Series, table: pd.DataFrame) -> float:
    """Returns the median ratio of an error in the past to that of drivers' own parameters."""
    own = table["past_rmse_speed_fixed"]
    ratio = (error / own.where(own > 0)).dropna()
    return float(ratio.median()) if len(ratio) else math.nan
