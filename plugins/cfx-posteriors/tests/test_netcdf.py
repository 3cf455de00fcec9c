"""ArviZ reads what `cfx export --to netcdf` writes."""

from __future__ import annotations

from pathlib import Path

import arviz_base
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from arviz_stats.base.array import array_stats

import cfx
from cfx.errors import DataError
from cfx_posteriors import nuts
from cfx_posteriors.netcdf import NetcdfExport


def test_a_jobs_posterior_is_labelled_arrays(tmp_path: Path) -> None:
    quick = ["debug=quick", "policy=fixed", "data.frames=200", "figures=none"]
    job = [f"hydra.run.dir={tmp_path}/job", "tracking.enabled=false"]
    result = cfx.run([*quick, *job, "calibration.posterior=laplace"])
    said = NetcdfExport().write(str(result.folder), None)
    assert "200 draws for each of 4 pairs" in said[0]
    tree = xr.open_datatree(tmp_path / "job" / "posterior.nc", engine="h5netcdf")
    assert arviz_base.extract(tree).sizes == {"sample": 200, "pair": 4}
    draws = pd.read_parquet(tmp_path / "job" / "posterior.parquet")
    for pair_id, rows in draws.groupby("pair_id"):
        one = tree["posterior"]["t_r"].sel(pair=pair_id, chain=0)
        np.testing.assert_array_equal(one.to_numpy(), rows["parameter_t_r"])
    assert tree["posterior"]["t_r"].attrs["units"] == "s"
    new = pd.read_parquet(tmp_path / "job" / "prior.parquet")
    np.testing.assert_array_equal(tree["prior"]["t_i"][0].to_numpy(), new["parameter_t_i"])
    assert dict(tree["diagnostics"]["pareto_k"].sizes) == {"pair": 4}


@pytest.mark.parametrize(
    ("method", "of_each", "others"), [("nuts", 50, "prior"), ("hierarchical", 100, "population")]
)
def test_chains_are_a_dimension(
    method: str, of_each: int, others: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nuts, "WARM_UP", 50)
    monkeypatch.setattr(nuts, "DRAWS", 50)
    quick = ["debug=quick", "policy=fixed", "data.frames=200", "figures=none"]
    job = [f"hydra.run.dir={tmp_path}/job", "tracking.enabled=false"]
    result = cfx.run([*quick, *job, f"calibration.posterior={method}"])
    NetcdfExport().write(str(result.folder), None)
    tree = xr.open_datatree(tmp_path / "job" / "posterior.nc", engine="h5netcdf")
    assert tree["posterior"].sizes == {"chain": nuts.CHAINS, "draw": of_each, "pair": 4}
    new = pd.read_parquet(tmp_path / "job" / f"{others}.parquet")
    np.testing.assert_array_equal(tree[others]["t_i"][0].to_numpy(), new["parameter_t_i"])
    draws = pd.read_parquet(tmp_path / "job" / "posterior.parquet")
    fits = pd.read_parquet(tmp_path / "job" / "fits.parquet").query("method == 'driver_specific'")
    for pair_id, rows in draws.groupby("pair_id"):
        one = tree["posterior"]["t_r"].sel(pair=pair_id)
        for chain, own in rows.groupby("chain"):
            np.testing.assert_array_equal(one.sel(chain=chain), own["parameter_t_r"])
        known = fits.query("pair_id == @pair_id").iloc[0]
        assert known["median_t_r"] == pytest.approx(float(one.median()), rel=1e-4)
        r_hat = float(tree["diagnostics"]["r_hat"].sel(pair=pair_id))
        chains = one.transpose("chain", "draw").to_numpy()
        # The largest of all coordinates and of deviations too; by rank, so that units are the same.
        assert r_hat == known["r_hat"] > float(array_stats.rhat(chains, 0, 1, "z_scale")) - 1e-9


def test_a_job_without_a_posterior_has_none_to_write(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cfx://idm: this job has found no posterior"):
        NetcdfExport().write("cfx://idm", tmp_path / "x.nc")
