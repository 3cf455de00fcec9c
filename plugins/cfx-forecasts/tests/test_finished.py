"""Forecasts by a finished job's policy: nothing is trained, and nothing is new."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import yaml

import cfx
from cfx.data.pairs import PairBatch
from cfx.errors import CfxError, DataError
from cfx.evaluation.closed_loop import Followers
from cfx.evaluation.forecasts import Origins
from cfx.policies import checkpoint
from cfx.simulation.rollout import MemoryStepper
from cfx_contracts import check_contract
from cfx_forecasts.protocol import Forecast
from tests.drives import simulate_from_origins
from tests.evaluation.protocols.test_transfer import HERE, ROLLOUT, elsewhere, trained

FORECAST = [
    *HERE,
    "protocol=forecast",
    "protocol.horizons=[0.5,2]",
    "protocol.stride=1",
    "protocol.histories=[]",
]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job with a stochastic policy that knows nothing of its drivers."""
    nothing = ["protocol.base=pooled", "protocol.history=0", "learner.cold_start_fraction=1"]
    head = ["learner.head=stochastic", "learner.paths=2"]
    return trained(tmp_path_factory.mktemp("jobs") / "drawn", *ROLLOUT, *nothing, *head)


@pytest.fixture(scope="module")
def forecast(drawn: Path) -> Forecast:
    return Forecast(run=drawn, horizons=(0.5, 1.0), stride=2.0, histories=())


def test_contract(forecast: Forecast) -> None:
    check_contract(forecast)


def job(base: list[str], run: Path, folder: Path, *overrides: str) -> cfx.plugin.Result:
    return cfx.run([*base, f"protocol.run={run}", f"hydra.run.dir={folder}", *overrides])


def test_the_finished_policy_forecasts_from_every_moment(drawn: Path, tmp_path: Path) -> None:
    result = job(
        FORECAST, drawn, tmp_path / "job", "protocol.samples=3", "protocol.stride=4", "model=w99"
    )
    config = yaml.safe_load((result.folder / "config.yaml").read_text())
    assert config["model"]["name"] == "krauss"
    assert len(pd.read_parquet(result.folder / "curves.parquet")) == 0
    notes = json.loads((result.folder / "data.json").read_text())["protocol"]
    assert notes["pairs_learned_from"] == 6
    table = pd.read_parquet(result.folder / "forecasts.parquet")
    rows = table[(table["method"] == "policy") & (table["horizon_s"] == 2.0)]
    batch = PairBatch.of(elsewhere())
    agent = checkpoint.load_agent(drawn / "policy").for_unseen_drivers()
    ids = {pair.pair_id: number for number, pair in enumerate(elsewhere())}
    origins = Origins(
        torch.tensor([ids[name] for name in rows["pair_id"]]),
        torch.tensor(np.rint(rows["history_s"].to_numpy() / 0.1).astype(int)),
    )
    paths = simulate_from_origins(
        MemoryStepper(cfx.get("model", "krauss")(), 0.1),
        agent,
        Followers(batch, torch.zeros(3, dtype=torch.int64), history=0.0),
        origins,
        20,
    )
    happened = batch.follower_speed[origins.pair, origins.frame + 20]
    np.testing.assert_allclose(
        rows["speed_error"], (paths.speed[:, 20] - happened).numpy(), atol=1e-9
    )
    scored = pd.read_parquet(result.folder / "distributions.parquet")
    assert {"policy", "pooled_ar", "driver_specific_ar"} <= set(scored["method"])


def test_who_was_learned_from_is_refused_and_who_is_too_short_is_left_out(
    drawn: Path, tmp_path: Path
) -> None:
    seen = ["data.seed=5", "data.pairs=6", "data.max_pairs=3"]
    with pytest.raises(DataError, match="has learned from 3 of the 3 pairs"):
        job(FORECAST, drawn, tmp_path / "seen", *seen)
    with pytest.raises(CfxError, match=r"no pair in .* lasts protocol.min_test_duration=20.1 s"):
        job(FORECAST, drawn, tmp_path / "long", "protocol.min_test_duration=20.1")
    with pytest.raises(DataError, match=r"protocol\.run=.*nowhere/policy holds no policy"):
        job(FORECAST, tmp_path / "nowhere", tmp_path / "job")


def test_a_ready_made_policy_forecasts(tmp_path: Path) -> None:
    result = cfx.run([*FORECAST, "protocol.run=cfx://idm", f"hydra.run.dir={tmp_path / 'job'}"])
    assert result.metrics["forecast/rmse_speed_2s/policy"] > 0
    assert (result.folder / "config.yaml").is_file()
