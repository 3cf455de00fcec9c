"""Fans of trajectories hold what happens as often as they say."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from cfx.models.krauss import Krauss
from cfx_posteriors.fan import fan_of

from .recordings import draw_recordings

SHARES = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)


@pytest.mark.parametrize("signal", ["speed", "gap"])
def test_with_true_parameters_a_forecast_holds_nine_in_ten(
    signal: Literal["speed", "gap"],
) -> None:
    drawn = draw_recordings(Krauss(), 150, signal=signal, seed=2)
    true = drawn.truth[:, None].expand(-1, 100, -1)
    frame = torch.full((150,), 305)
    fan = fan_of(drawn.posterior, frame, true, SHARES, seed=0, memory=1 << 30)
    two = torch.tensor([0, 7])
    alone = fan_of(drawn.posterior.take(two), frame[two], true[two], SHARES, seed=0, memory=1)
    torch.testing.assert_close(fan.quantiles[two], alone.quantiles)
    check = fan.check(seed=0)
    assert float(check["held"].mean()) == pytest.approx(0.9, abs=0.05)
    assert float((check["held_chance"] < 0.05).double().mean()) < 0.12
    assert fan.time[:2].tolist() == [1.0, 2.0]
    table = fan.table([f"p{number}" for number in range(150)])
    assert table["calibrated_on"].sum() == 150 * 30
    simulated = table[table["calibrated_on"]]
    assert (simulated["low"] == simulated["high"]).all(), "one trajectory, without noise"
    ahead = table[~table["calibrated_on"]]
    held = (ahead["low"] <= ahead["measured"]) & (ahead["measured"] <= ahead["high"])
    assert 0.85 < held.mean() < 0.95
    error = (ahead["median"] - ahead["measured"]).abs().groupby(ahead["time_s"]).median()
    assert error[31.0] < error[58.0], "doubt grows"


def test_a_fan_that_is_too_narrow_is_found_out() -> None:
    drawn = draw_recordings(Krauss(), 40, seed=2)
    sure = drawn.truth.clone()
    sure[:, -1] -= 1.0  # a third of the noise
    true = sure[:, None].expand(-1, 100, -1)
    frame = torch.full((40,), 305)
    check = fan_of(drawn.posterior, frame, true, SHARES, seed=0, memory=1 << 30).check(seed=0)
    assert float(check["held"].mean()) < 0.7
    assert float((check["held_chance"] < 0.05).double().mean()) > 0.3


def test_without_a_held_out_part_there_is_nothing_to_check() -> None:
    drawn = draw_recordings(Krauss(), 2, frames=60)
    true = drawn.truth[:, None].expand(-1, 10, -1)
    frame = torch.full((2,), 59)
    check = fan_of(drawn.posterior, frame, true, SHARES, seed=0, memory=1 << 30).check(seed=0)
    assert bool(check["held"].isnan().all())
    assert bool(check["held_chance"].isnan().all())
