"""How forecasts become errors, and what the kinematic ones are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from cfx.data.pairs import PairBatch
from cfx.evaluation.forecasts import Origins, measured_paths
from cfx.models.krauss import Krauss
from cfx_forecasts.errors import (
    errors_by,
    forecast_errors,
    forecast_metrics,
    forecast_values,
    kinematic_paths,
    summarize_forecasts,
)
from tests.drives import straight_pairs, wavy_pairs

MODEL = Krauss()
STEPS = 30


@pytest.fixture(scope="module")
def batch() -> PairBatch:
    true = MODEL.space.defaults() + torch.tensor([[0.0, 0.0], [0.8, 0.2], [1.5, 0.1]]).double()
    return PairBatch.of(wavy_pairs(MODEL, true))


def test_kinematic_forecasts_are_the_closed_forms(batch: PairBatch) -> None:
    origins = Origins(torch.tensor([0, 1, 2]), torch.tensor([100, 120, 140]))
    speed = batch.follower_speed[origins.pair, origins.frame]
    acceleration = batch.follower_acceleration[origins.pair, origins.frame]
    steady = kinematic_paths(batch, origins, STEPS, accelerates=False)
    torch.testing.assert_close(steady.travelled[:, -1], 3.0 * speed)
    paths = kinematic_paths(batch, origins, STEPS, accelerates=True)
    expected = (speed + 3.0 * acceleration).clamp(min=0.0)
    torch.testing.assert_close(paths.speed[:, -1], expected)
    moves = (expected > 0) & (speed > 0)
    # Steps with the new speed: half a step more than the integral.
    way = 3.0 * speed + 0.5 * acceleration * 3.0 * (3.0 + 0.1)
    torch.testing.assert_close(paths.travelled[moves, -1], way[moves])


def test_who_brakes_stops_and_does_not_drive_back() -> None:
    batch = PairBatch.of(straight_pairs([100], speed=2.0))
    braking = torch.full_like(batch.follower_acceleration, -1.0)
    origins = Origins(torch.tensor([0]), torch.tensor([50]))
    paths = kinematic_paths(
        replace(batch, follower_acceleration=braking), origins, 60, accelerates=True
    )
    assert float(paths.speed[0, -1]) == 0.0
    assert float(paths.travelled[0, -1]) == pytest.approx(
        0.1 * sum(2 - 0.1 * k for k in range(21)) - 0.2
    )


def test_errors_are_means_over_drivers_of_the_rmse_over_their_origins() -> None:
    """A driver with many origins counts as much as one with few."""
    pairs = straight_pairs([400, 100])
    batch = PairBatch.of(pairs)
    origins = Origins.every(10, torch.tensor([50, 50]), batch.lengths - 11)
    measured, recorded = measured_paths(batch, origins, 10)
    off = torch.where(origins.pair == 0, 1.0, 3.0).double()[:, None]
    ramp = torch.linspace(0.0, 1.0, 11).double()
    path = measured._replace(
        speed=measured.speed + off * ramp, travelled=measured.travelled - 2.0 * off * ramp
    )
    table = forecast_errors(pairs, origins, {"policy": path}, measured, recorded, (0.5, 1.0), 0.1)
    metrics = forecast_metrics(table)
    assert metrics["forecast/rmse_speed_1s/policy"] == pytest.approx(2.0)
    assert metrics["forecast/rmse_speed_0.5s/policy"] == pytest.approx(1.0)
    assert metrics["forecast/fde_1s/policy"] == pytest.approx(4.0)
    assert metrics["forecast/ade_1s/policy"] == pytest.approx(4.0 * np.mean(ramp[1:].numpy()))
    low = metrics["forecast/rmse_speed_1s/policy/ci95_low"]
    # Two drivers, of 1 and 3 m/s: Student's t with one degree of freedom.
    margin = stats.t.ppf(0.975, 1)
    high = metrics["forecast/rmse_speed_1s/policy/ci95_high"]
    assert (low, high) == pytest.approx((2.0 - margin, 2.0 + margin))
    row = summarize_forecasts(table).iloc[-1]
    assert (row["drivers"], row["origins"]) == (2, 34 + 4)
    values = forecast_values(table)
    own = values[(values["metric"] == "rmse_position_1s") & (values["pair_id"] == "p1")]
    assert own["value"].tolist() == pytest.approx([6.0])
    assert set(values["scope"]) == {"forecast"}


def test_a_horizon_counts_origins_whose_recording_lasts_that_long() -> None:
    pairs = straight_pairs([81])
    batch = PairBatch.of(pairs)
    origins = Origins.every(10, torch.tensor([50]), torch.tensor([70]))
    measured, recorded = measured_paths(batch, origins, 20)
    table = forecast_errors(
        pairs, origins, {"policy": measured}, measured, recorded, (1.0, 2.0), 0.1
    )
    counts = errors_by(table, ["horizon_s"]).set_index("horizon_s")["origins"]
    assert counts.to_dict() == {1.0: 3, 2.0: 2}
    assert not table.isna().to_numpy().any()
    assert pd.api.types.is_float_dtype(table["history_s"])
