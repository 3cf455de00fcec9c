"""Results by site."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from cfx.data.pairs import PairSet
from cfx.evaluation.result import Evaluation
from cfx.evaluation.sites import site_table
from cfx.evaluation.tables import long_table
from tests.drives import straight_pairs

SITES = ("road",) * 6 + ("track",) * 2
KINDS = ("",) * 6 + ("acc", "human")
FIXED = np.array([1.0] * 6 + [2.0, 2.0])
POLICY = np.array([0.8] * 6 + [1.0, 2.0])


def made(sites: tuple[str, ...]) -> pd.DataFrame | None:
    pairs = PairSet(
        tuple(
            replace(pair, pair_id=str(k), recording=str(k), site=site, driver_type=kind)
            for k, (pair, site, kind) in enumerate(
                zip(straight_pairs([10] * len(sites)), sites, KINDS, strict=True)
            )
        ),
        "test",
    )
    measured = {}
    for metric in ("rmse_speed", "rmse_gap"):
        measured[metric, "test", "driver_specific"] = FIXED
        measured[metric, "test", "policy"] = POLICY
    ids = [pair.pair_id for pair in pairs]
    values = long_table(ids, [pair.driver for pair in pairs], measured)
    evaluation = Evaluation(
        about=pd.DataFrame({"pair_id": ids, "method": "policy"}),
        values=values,
        measured=(),
        improvements={},
        trajectories=(),
        parameters=(),
    )
    return site_table(pairs, evaluation)


def test_each_site_has_a_row_and_each_counts_once_in_the_row_of_all() -> None:
    table = made(SITES)
    assert table is not None
    rows = table.set_index(["site", "driver_type"])
    assert rows["over_driver_specific"].to_dict() == pytest.approx(
        {
            ("road", "all"): 0.2,
            ("track", "all"): 1 - math.sqrt(0.5),
            ("track", "acc"): 0.5,
            ("track", "human"): 0.0,
            ("all", "all"): 1 - math.sqrt(0.8 * math.sqrt(0.5)),
        }
    )
    assert rows.loc[("all", "all"), "rmse_speed_policy"] == pytest.approx((0.8 + 1.5) / 2)
    assert rows.loc[("all", "all"), "drivers"] == 8


def test_one_site_needs_no_table() -> None:
    assert made(("",) * 8) is None
