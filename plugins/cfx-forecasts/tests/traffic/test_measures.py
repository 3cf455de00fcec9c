"""Flow and density of made-up trajectories whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import torch

from cfx_forecasts.traffic.edie import STRIP_S, region, strips_of
from cfx_forecasts.traffic.summary import binned, common_variation, flow_errors
from cfx_forecasts.traffic.tables import STRIP_COLUMNS
from tests.evaluation.test_waves import DT, times


def test_a_strip_has_edies_density_and_flow() -> None:
    """Spacing 20 m and 8 m/s: 50 vehicles/km and 1,440 vehicles/h."""
    frames = round(STRIP_S / DT)
    spacing = torch.full((2, 2 * frames + 3), 20.0).double()
    speed = torch.full_like(spacing, 8.0)
    counted = torch.ones_like(spacing, dtype=torch.bool)
    counted[1, frames + 4 :] = False
    found = strips_of(spacing, speed, counted, DT)
    assert found.pair.tolist() == [0, 0, 1]
    assert torch.allclose(found.density, torch.full((3,), 50.0).double())
    assert torch.allclose(found.flow, torch.full((3,), 1440.0).double())
    assert torch.allclose(found.speed_std, torch.zeros(3).double())


def test_a_region_counts_time_and_way_of_those_inside() -> None:
    t = times(100.0)
    place = torch.stack([20.0 + 10.0 * t, 10.0 * t, -20.0 + 10.0 * t])
    found = region(place[:, 60:100], torch.full_like(place, 10.0)[:, 60:100], 100.0, 2000.0)
    assert found.speed == pytest.approx(10.0)
    assert found.density == pytest.approx(3 / 1.9)
    assert found.flow == pytest.approx(3 / 1.9 * 36.0)
    assert math.isnan(region(place, place, -900.0, -800.0).speed)


def strips(method: str, density: float, flow: float, count: int = 12) -> pd.DataFrame:
    values = [[method, density, flow, 0.3]] * count
    return pd.DataFrame(values, columns=list(STRIP_COLUMNS))


def test_flows_are_compared_in_the_bins_that_both_have() -> None:
    table = pd.concat(
        [
            strips("real", 33.0, 1500.0),
            strips("real", 45.0, 1200.0),
            strips("real", 75.0, 700.0),
            strips("driver_specific", 37.0, 1600.0),
            strips("driver_specific", 45.0, 1000.0),
            strips("driver_specific", 75.0, 100.0, count=3),
        ]
    )
    bins = binned(table)
    assert set(bins["density"]) == {35.0, 45.0, 75.0}
    assert flow_errors(bins)["driver_specific"] == pytest.approx(math.sqrt((100**2 + 200**2) / 2))
    assert common_variation(bins) == {
        "real": pytest.approx(0.3),
        "driver_specific": pytest.approx(0.3),
    }
    assert flow_errors(bins[bins["method"] == "driver_specific"]) == {}


def test_the_flow_of_a_bin_is_that_of_all_strips_together() -> None:
    """A strip counts by its area: way over area of both, not the mean of flows."""
    table = pd.concat([strips("real", 40.0, 1200.0), strips("real", 48.0, 600.0)])
    (row,) = binned(table).to_dict("records")
    areas = np.array([1 / 40.0, 1 / 48.0])
    assert row["flow"] == pytest.approx((areas * [1200.0, 600.0]).sum() / areas.sum())
