"""Waves of made-up trajectories whose speeds are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.evaluation.waves import pair_waves, ring_waves

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
