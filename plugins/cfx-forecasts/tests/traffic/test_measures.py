"""Flow, density and waves of made-up trajectories whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.evaluation.waves import pair_waves, ring_waves
from cfx_forecasts.traffic.edie import STRIP_S, region, strips_of
from cfx_forecasts.traffic.summary import binned, common_variation, flow_errors
from cfx_forecasts.traffic.tables import STRIP_COLUMNS

DT = 0.5


def times(seconds: float = 300.0) -> torch.Tensor:
    return DT * torch.arange(round(seconds / DT) + 1, dtype=torch.float64)


@settings(max_examples=15)
@given(st.floats(-8.0, -1.0), st.integers(1, 4), st.floats(0.0, 6.0))
def test_waves_of_a_ring_are_found(wave: float, mode: int, phase: float) -> None:
    """Vehicles drive through a wave and measure it where they are."""
    circumference, vehicles = 1000.0, 40
    place = 25.0 * torch.arange(vehicles, 0, -1, dtype=torch.float64)[:, None] + 8.0 * times()
    angle = 2.0 * torch.pi * mode * (place - wave * times()) / circumference
    speed = 8.0 + 2.0 * torch.cos(angle + phase)
    found = ring_waves(place, speed, circumference, DT)
    assert found.speed == pytest.approx(wave, abs=0.02)
    assert found.coherence == pytest.approx(1.0, abs=5e-3)


def test_a_steady_ring_has_no_waves() -> None:
    place = 25.0 * torch.arange(20, 0, -1, dtype=torch.float64)[:, None] + 8.0 * times()
    assert math.isnan(ring_waves(place, torch.full_like(place, 8.0), 500.0, DT).speed)


@settings(max_examples=15)
@given(st.floats(0.8, 3.0), st.floats(4.0, 12.0), st.integers(0, 10_000))
def test_followers_of_newell_pass_waves_on_at_his_speed(
    lag: float, behind: float, seed: int
) -> None:
    """x_f(t) = x_l(t - tau) - d: the wave travels at -d / tau (Newell, 2002)."""
    rng = np.random.default_rng(seed)
    rates = rng.uniform(0.05, 0.4, 6)
    phases = rng.uniform(0, 6.28, 6)

    def position(t: torch.Tensor) -> torch.Tensor:
        moved = 8.0 * t
        for rate, phase in zip(rates, phases, strict=True):
            moved = moved + 0.8 / rate * torch.sin(rate * t + phase)
        return moved

    def speed(t: torch.Tensor) -> torch.Tensor:
        found = torch.full_like(t, 8.0)
        for rate, phase in zip(rates, phases, strict=True):
            found = found + 0.8 * torch.cos(rate * t + phase)
        return found

    t = times()
    found = pair_waves(
        position(t)[None],
        speed(t)[None],
        (position(t - lag) - behind)[None],
        speed(t - lag)[None],
        torch.ones((1, len(t)), dtype=torch.bool),
        DT,
    )
    assert found.speed == pytest.approx(-behind / lag, rel=0.03)


def test_pairs_without_changes_or_without_following_have_no_wave() -> None:
    t = times(60.0)
    steady, changing = torch.full_like(t, 8.0), 8.0 + 2.0 * torch.sin(t / 5)
    leaders = torch.stack([steady, changing])
    followers = torch.stack([changing, 8.0 + 0.1 * torch.sin(3.0 * t)])
    place = torch.stack([8.0 * t, 8.0 * t])
    counted = torch.ones((2, len(t)), dtype=torch.bool)
    found = pair_waves(place + 20, leaders, place, followers, counted, DT)
    assert math.isnan(found.speed)
    short = pair_waves(
        place[:, :2], leaders[:, :2], place[:, :2], followers[:, :2], counted[:, :2], DT
    )
    assert short.measured == 0


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
