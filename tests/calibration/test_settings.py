"""Settings of calibration that do nothing without others are refused."""

from __future__ import annotations

import pytest

from cfx.calibration.settings import CalibrationSettings
from cfx.core.component import validate
from cfx.errors import ConfigError


@pytest.mark.parametrize(
    ("key", "value"), [("noise", "both"), ("noise_step_s", 2.0), ("noise_order", 3)]
)
def test_noise_belongs_to_a_posterior(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"calibration.{key}={value}: there is no posterior"):
        validate(CalibrationSettings, {key: value}, where="calibration")
    given = validate(CalibrationSettings, {key: value, "posterior": "laplace"}, where="calibration")
    assert getattr(given, key) == value


def test_white_noise_has_no_order() -> None:
    values = {"posterior": "laplace", "noise": "measurement", "noise_order": 2}
    with pytest.raises(
        ConfigError, match=r"noise_order=2: calibration\.noise=measurement is white"
    ):
        validate(CalibrationSettings, values, where="calibration")
