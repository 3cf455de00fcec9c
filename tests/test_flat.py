"""A parameter that recordings do not determine is marked in tables and metrics."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest


def test_tables_and_metrics_say_it_and_it_is_held_at_its_default(flat_job: Path) -> None:
    table = pd.read_csv(flat_job / "pairs.csv")
    fixed = table[table["method"] == "driver_specific"]
    assert (fixed["flat_b"] == 1).all()
    assert fixed["parameter_b"].to_list() == pytest.approx([4.5] * 3, abs=1e-3)
    assert (fixed["flat_cc1"] < 1).all()
    assert table.loc[table["method"] != "driver_specific", "flat_b"].isna().all()
    metrics = json.loads((flat_job / "metrics.json").read_text())
    assert metrics["flat/b"] == 1
    assert metrics["flat/cc1"] == 0
