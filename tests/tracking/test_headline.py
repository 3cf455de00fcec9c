"""What a table of runs shows first."""

from __future__ import annotations

import pytest

from cfx.tracking.headline import headline, without_improvements

METRICS = {
    "rmse_improvement/mean": 0.21584,
    "rmse_improvement/ci95_low": 0.1688,
    "rmse_improvement/ci95_high": 0.2621,
    "steady/rmse_improvement/mean": 0.13,
    "rmse_speed/policy": 0.58432,
    "rmse_speed/fixed": 0.7351,
    "rmse_speed/population": 0.6861,
}


def test_an_improvement_is_in_percent_with_its_interval() -> None:
    values, words = headline(METRICS, adapts=True)
    assert words == "+21.6 % (+16.9 to +26.2) over driver-specific; RMSE of speed 0.584 m/s"
    assert values == {
        "improvement_percent": 21.6,
        "improvement_low_percent": 16.9,
        "improvement_high_percent": 26.2,
        "rmse_speed_mps": 0.584,
    }


def test_without_driver_specific_parameters_it_is_over_pooled_ones() -> None:
    metrics = {"full_trajectory/rmse_improvement/population/mean": 0.1}
    assert headline(metrics, adapts=True) == ({"improvement_percent": 10.0}, "+10.0 % over pooled")


def test_a_calibration_improves_nothing() -> None:
    values, words = headline(METRICS, adapts=False)
    assert words == "calibration; driver-specific 0.735 m/s; pooled 0.686 m/s"
    assert values == {"rmse_speed_mps": 0.735}
    kept = without_improvements(METRICS)
    assert set(kept) == {"rmse_speed/policy", "rmse_speed/fixed", "rmse_speed/population"}


@pytest.mark.parametrize("adapts", [True, False])
def test_what_is_not_defined_is_not_said(adapts: bool) -> None:
    metrics = {"rmse_improvement/mean": float("nan"), "rmse_speed/policy": float("nan")}
    values, words = headline(metrics, adapts=adapts)
    assert values == {}
    assert words == ("" if adapts else "calibration")
