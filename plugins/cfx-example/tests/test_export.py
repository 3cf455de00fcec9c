"""What the export writes, and what it says where there is nothing to write."""

import json

import cfx
import pandas as pd
import pytest
from cfx.errors import DataError

from cfx_example.export import FILE, DriverJson


def job(folder, methods):
    """Writes a table of one pair, as a job does; returns its folder."""
    names = {"pair_id": "7", "driver": "7", "cluster": "normal", "method": methods}
    errors = {
        "rmse_speed": 0.5,
        "rmse_gap": 2.0,
        "collisions": 0,
        "improvement_over_driver_specific": 0.0,
    }
    rows = pd.DataFrame({**names, **errors, "frames": 100, "parameter_tau": [1.5, 1.0]})
    rows.to_csv(folder / "pairs.csv", index=False)
    return str(folder)


def test_cfx_finds_it():
    found = cfx.get("export", "driver_json")
    assert found is DriverJson, "install it first: pip install --editable ."


def test_it_writes_what_was_calibrated_to_each_driver(tmp_path):
    (said,) = DriverJson().write(job(tmp_path, ["driver_specific", "default"]), None)
    assert said == f"parameters of 1 drivers: {tmp_path / FILE}"
    assert json.loads((tmp_path / FILE).read_text()) == {"7": {"tau": 1.5}}


def test_it_writes_where_the_user_says(tmp_path):
    path = tmp_path / "other" / "parameters.json"
    DriverJson().write(job(tmp_path, ["driver_specific", "default"]), path)
    assert path.is_file()


def test_a_job_that_calibrated_nobody_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match="holds no driver-specific parameters"):
        DriverJson().write(job(tmp_path, ["default", "pooled"]), None)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no pairs\.csv"):
        DriverJson().write(str(tmp_path / "empty"), None)
