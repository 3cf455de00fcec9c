"""Optimizers find the parameters of drivers who have constant and known ones, in a whole job."""

from __future__ import annotations

from pathlib import Path

import pytest

import cfx


@pytest.mark.parametrize(
    "overrides",
    [["optimizer=cma", "calibration.prior=none"], ["optimizer=differential_evolution"]],
    ids=lambda overrides: overrides[0],
)
def test_cfx_recovers_known_drivers(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["data.pairs=3", "data.platoon_size=1", "data.variation=0", "data.frames=400"]
    result = cfx.run(
        [
            *overrides,
            "model=krauss",
            "policy=fixed",
            "protocol=within_driver",
            "data=synthetic",
            *options,
            "tracking.enabled=false",
            "figures=none",
        ]
    )
    truth = cfx.get("dataset", "synthetic")(pairs=3, platoon_size=1, variation=0, frames=400).load()
    calibrated = (
        result.pairs[result.pairs.method == "driver_specific"].set_index("pair_id").parameter_t_r
    )
    for pair in truth:
        assert calibrated[pair.pair_id] == pytest.approx(pair.truth["t_r"][0], abs=0.05)
    assert (
        result.metrics["rmse_speed/driver_specific"] < 0.01 * result.metrics["rmse_speed/default"]
    )
