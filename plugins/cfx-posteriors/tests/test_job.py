"""Jobs with `calibration.posterior`: what they say of parameters, and what they leave as it is."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import cfx
from cfx.errors import ConfigError
from cfx.models.krauss import Krauss
from tests.test_job_posterior import QUICK


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_intervals_stand_beside_the_same_point_estimates(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plain = cfx.run([*QUICK, "hydra.run.dir=plain"])
    capsys.readouterr()
    known = cfx.run([*QUICK, "hydra.run.dir=known", "calibration.posterior=laplace"])
    for name, value in plain.metrics.items():
        assert known.metrics[name] == value
    pd.testing.assert_frame_equal(plain.pairs, known.pairs)
    printed = capsys.readouterr().out
    assert "What the recordings say of parameters" in printed
    fits = pd.read_parquet("known/fits.parquet")
    rows, others = (
        fits[fits["method"] == "driver_specific"],
        fits[fits["method"] != "driver_specific"],
    )
    assert len(rows) == 3
    for name in known.evaluation.names:
        assert (rows[f"low_{name}"] < rows[f"median_{name}"]).all()
        assert (rows[f"median_{name}"] < rows[f"high_{name}"]).all()
        assert (rows[f"contraction_{name}"] < 1).all()
        assert others[f"median_{name}"].isna().all()
        known_well = (rows[f"contraction_{name}"] >= 0.3) & (rows["pareto_k"] <= 0.7)
        share = float(known_well.mean())
        assert known.metrics[f"posterior/determined/{name}"] == share
    assert known.metrics["posterior/reliable"] == float((rows["pareto_k"] <= 0.7).mean())
    draws = pd.read_parquet("known/posterior.parquet").groupby("pair_id")
    for name in known.evaluation.names:
        middle = draws[f"parameter_{name}"].median()[rows["pair_id"]].to_numpy()
        assert (rows[f"low_{name}"] < middle).all()
        assert (middle < rows[f"high_{name}"]).all()
    prior = pd.read_parquet("known/prior.parquet")
    for name in known.evaluation.names:
        before = prior[f"parameter_{name}"].quantile([0.05, 0.95]).diff().iloc[1]
        assert (rows[f"high_{name}"] - rows[f"low_{name}"]).min() < before
    assert not Path("known/population.parquet").exists()
    fan = pd.read_parquet("known/fan.parquet").groupby("pair_id")
    assert fan.size().tolist() == [39, 39, 39]  # frames 10, 20, ... 390 of 0 to 399
    for _, own in fan:
        assert (own["low"] <= own["median"]).all()
        assert (own["median"] <= own["high"]).all()
        assert own["calibrated_on"].tolist() == [True] * 31 + [False] * 8  # up to frame 319
    assert "noise_scale" not in pd.read_parquet("plain/fits.parquet")


def test_the_power_of_a_likelihood_stands_beside_intervals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = cfx.read(dataset="synthetic", pairs=2, frames=200, variation=0.0)
    whole = cfx.calibrate(pairs, "krauss", posterior="laplace").intervals
    monkeypatch.setattr(Krauss, "likelihood_power", 0.25)
    quarter = cfx.calibrate(pairs, "krauss", posterior="laplace").intervals
    assert "likelihood_power" not in whole
    assert quarter["likelihood_power"].tolist() == [0.25, 0.25]
    assert (quarter["contraction_t_r"] < whole["contraction_t_r"]).all()


def test_a_population_as_the_prior_leaves_less_doubt() -> None:
    doubt = {}
    for kind in ("laplace", "hierarchical"):
        cfx.run([*QUICK, f"hydra.run.dir={kind}", f"calibration.posterior={kind}"])
        fits = pd.read_parquet(f"{kind}/fits.parquet")
        rows = fits[fits["method"] == "driver_specific"]
        width = [rows[f"high_{name}"] - rows[f"low_{name}"] for name in Krauss().space.names]
        doubt[kind] = pd.concat(width, axis=1).mean()
    assert (doubt["hierarchical"] < doubt["laplace"]).all()
    drawn = pd.read_parquet("hierarchical/population.parquet")
    assert len(drawn) == 1000
    low, high = Krauss().space.bounds()
    assert (drawn.to_numpy() >= low.numpy()).all()
    assert (drawn.to_numpy() <= high.numpy()).all()


def test_chains_of_another_simulator_are_refused() -> None:
    pytest.importorskip("libsumo", reason="SUMO is not here")
    pytest.importorskip("cfx_sumo", reason="the other simulator is that of cfx-sumo")
    with pytest.raises(ConfigError, match="simulator=memory alone"):
        cfx.run([*QUICK, "model=krauss_sumo", "simulator=sumo", "calibration.posterior=nuts"])
