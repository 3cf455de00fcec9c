"""The one number by which a job is known."""

from __future__ import annotations

import math
from dataclasses import replace

from cfx.evaluation.headline import fitted_errors, headline, interval_in_words, main_error
from cfx.evaluation.metrics.base import RMSE_SPEED

METRICS = {
    "improvement/rmse_speed/driver_specific/geometric": 0.21584,
    "improvement/rmse_speed/driver_specific/ci95_low": 0.1688,
    "improvement/rmse_speed/driver_specific/ci95_high": 0.2621,
    "steady/improvement/rmse_speed/driver_specific/geometric": 0.13,
    "rmse_speed/policy": 0.58432,
    "rmse_speed/driver_specific": 0.7351,
    "rmse_speed/pooled": 0.6861,
}


def test_an_improvement_is_in_percent_with_its_interval_and_names_a_better_baseline() -> None:
    values, words = headline(METRICS)
    assert words == (
        "+21.6 % (+16.9 to +26.2) over driver-specific;"
        " RMSE of speed 0.584 m/s (driver-specific 0.735 m/s, pooled 0.686 m/s)"
    )
    assert values == {
        "improvement_percent": 21.6,
        "improvement_low_percent": 16.9,
        "improvement_high_percent": 26.2,
        "rmse_speed_mps": 0.584,
        "rmse_speed_driver_specific_mps": 0.735,
        "rmse_speed_pooled_mps": 0.686,
    }


def test_an_interval_that_may_begin_anywhere_says_no_more() -> None:
    assert interval_in_words(-0.012, 0.034) == "-1.2 to +3.4"
    assert interval_in_words(-8.6e14, 1.0, " %") == "below -1000 % to +100.0 %"
    assert interval_in_words(math.nan, math.nan) == "one driver"


def test_mean_errors_that_contradict_are_told() -> None:
    """A few drivers with large errors outweigh all others in a ratio of mean errors."""
    metrics = {
        "improvement/rmse_speed/driver_specific/geometric": -0.014,
        "improvement/rmse_speed/driver_specific/ratio_of_means": 0.124,
        "improvement/rmse_speed/driver_specific/drivers": 5.0,
        "rmse_speed/policy": 0.624,
        "rmse_speed/driver_specific": 0.712,
    }
    _, words = headline(metrics)
    assert words == (
        "-1.4 % over driver-specific, of the mean errors +12.4 %, 5 drivers;"
        " RMSE of speed 0.624 m/s (driver-specific 0.712 m/s)"
    )


def test_without_driver_specific_parameters_it_is_over_pooled_ones() -> None:
    metrics = {"full_trajectory/improvement/rmse_speed/pooled/geometric": 0.1}
    words = "+10.0 % over pooled on full trajectories"
    assert headline(metrics) == ({"improvement_percent": 10.0}, words)


def test_a_baseline_whose_error_is_not_known_has_no_error_in_the_words() -> None:
    _, words = headline(
        {"improvement/rmse_speed/driver_specific/geometric": 0.1, "rmse_speed/policy": 0.5}
    )
    assert words == "+10.0 % over driver-specific; RMSE of speed 0.500 m/s"


def test_a_calibration_is_known_by_driver_specific_parameters() -> None:
    metrics = {"rmse_speed/driver_specific": 0.7351, "rmse_speed/pooled": 0.6861}
    values, words = headline(metrics)
    assert words == "RMSE of speed driver-specific 0.735 m/s, pooled 0.686 m/s"
    assert values == {
        "rmse_speed_mps": 0.735,
        "rmse_speed_driver_specific_mps": 0.735,
        "rmse_speed_pooled_mps": 0.686,
    }
    assert main_error(metrics, "rmse_speed") == 0.7351
    assert main_error(METRICS, "rmse_speed") == 0.58432


def test_the_error_that_was_minimised_comes_first() -> None:
    judge = replace(RMSE_SPEED, name="rmse_gap", unit="m", heading="RMSE of gap")
    metrics = {
        "improvement/rmse_gap/driver_specific/geometric": 0.25,
        "rmse_gap/policy": 3.3,
        "rmse_gap/driver_specific": 5.2,
        **METRICS,
    }
    values, words = headline(metrics, judge)
    assert words == (
        "+25.0 % over driver-specific; RMSE of gap 3.300 m (driver-specific 5.200 m);"
        " RMSE of speed 0.584 m/s (driver-specific 0.735 m/s, pooled 0.686 m/s)"
    )
    assert list(values)[:2] == ["improvement_percent", "rmse_gap_m"]
    assert values["rmse_gap_driver_specific_m"] == 5.2
    assert main_error(metrics, "rmse_gap") == 3.3


def test_what_is_asked_first_of_the_judged_method_has_no_group() -> None:
    of_all = {}
    for method, value in (("policy", 1.0), ("driver_specific", 2.0)):
        of_all |= {f"rmse_gap/{method}": value, f"collisions/{method}": value}
    values, _ = headline({**METRICS, **of_all})
    assert (values["rmse_gap_m"], values["collisions"]) == (1.0, 1.0)
    assert len(values) <= 10
    del of_all["rmse_gap/policy"]
    calibrated = {name: value for name, value in of_all.items() if "policy" not in name}
    values, _ = headline({"rmse_speed/driver_specific": 0.7, **calibrated})
    assert (values["rmse_gap_m"], values["collisions"]) == (2.0, 2.0)
    assert fitted_errors({"rmse_speed": 0.41234, "rmse_gap": math.nan}) == {
        "rmse_speed_fitted_mps": 0.412
    }


def test_what_is_not_defined_is_not_said() -> None:
    metrics = {
        "improvement/rmse_speed/driver_specific/geometric": math.nan,
        "rmse_speed/policy": math.nan,
    }
    assert headline(metrics) == ({}, "")
    assert headline({}) == ({}, "")
