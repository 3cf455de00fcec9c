"""Finds calibrated parameters that a recording does not determine: their loss is flat.

From a driver's calibrated parameters one is moved from bound to bound, the others stay. Where the
loss is within `NEAR` of its best it counts as nearly as good. The *flat share* is the share of the
range on which it is. A parameter is *flat* for a driver where that is all of it: any value fits as
well, so that theirs says nothing of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

NEAR = 0.05
"""A loss that is higher than the best by no more than this share of it counts as nearly as good."""

COLUMN = "flat_"
"""Prefix of the columns of flat shares."""


def flat_shares(slices: pd.DataFrame) -> pd.DataFrame:
    """Returns the flat share of each parameter for each pair, a column per parameter.

    Args:
        slices: as `cfx.calibration.identifiability.slices` returns it. A pair whose best loss is 0
            or no number has none: NaN.
    """
    best = slices["best_loss"].where(np.isfinite(slices["best_loss"]) & (slices["best_loss"] > 0))
    near = (slices["loss"] <= (1 + NEAR) * best).astype(float).where(best.notna())
    rows = slices[["pair_id", "parameter"]].assign(near=near)
    wide = rows.pivot_table(index="pair_id", columns="parameter", values="near")
    return wide.reindex(columns=slices["parameter"].unique())


def with_flat_shares(
    about: pd.DataFrame, slices: pd.DataFrame, names: Sequence[str]
) -> pd.DataFrame:
    """Returns a table of pairs and methods with a column `flat_NAME` for each parameter.

    It holds the flat shares of the method `fixed`, whose parameters they are of; else NaN.
    """
    shares = flat_shares(slices)
    columns = {}
    for name in names:
        values = about["pair_id"].map(shares[name])
        columns[f"{COLUMN}{name}"] = values.where(about["method"] == "fixed")
    return about.assign(**columns)


def flat_for(table: pd.DataFrame, names: Sequence[str]) -> dict[str, float]:
    """Returns for which share of the pairs each parameter is flat; without those of no share.

    Args:
        table: a row per pair and method, with columns as of `with_flat_shares` if they are known.
        names: of the parameters.
    """
    found = {}
    for name in names:
        if f"{COLUMN}{name}" in table:
            known = table[f"{COLUMN}{name}"].dropna()
            if len(known):
                found[name] = float((known == 1).mean())
    return found
