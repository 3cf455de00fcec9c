"""Policies that were trained elsewhere: who drives, from what, and who may not be tested."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml

import cfx
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.tidy import TidyDataset, frame_of, write_tidy
from cfx.errors import CfxError, DataError, TrackingError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.protocols.transfer import Transfer
from cfx.policies import checkpoint
from cfx.policies.core import ANY_DRIVER
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx_contracts import check_contract

QUICK = [
    "debug=quick",
    "data.max_pairs=null",
    "data.platoon_size=1",
    "data.frames=200",
    "figures=none",
    "tracking.enabled=false",
    "calibration.prior=none",
]
TRAINED = [*QUICK, "data.pairs=6", "data.seed=5"]
HERE = [*QUICK, "data.pairs=3", "data.seed=9", "protocol=transfer"]
ACROSS = [
    "protocol=across_drivers",
    "protocol.folds=2",
    "protocol.histories=[]",
    "policy.inputs=situation",
    "learner=rollout",
]
ROLLOUT = [
    *ACROSS,
    "learner.epochs=1",
    "learner.steps=3",
    "learner.horizon=4",
    "learner.ensemble_size=2",
]


def trained(folder: Path, *overrides: str) -> Path:
    return cfx.run(
        [*TRAINED, f"hydra.run.dir={folder}", f"cache.folder={folder.parent / 'cache'}", *overrides]
    ).folder


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job whose policy knows nothing of its drivers."""
    nothing = ["protocol.base=pooled", "protocol.history=0", "learner.cold_start_fraction=1"]
    return trained(tmp_path_factory.mktemp("jobs") / "unseen", *ROLLOUT, *nothing)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job whose policy starts from driver-specific parameters, and has a residual."""
    own = ["protocol.shrinkage=0.3", "learner.head=residual"]
    return trained(tmp_path_factory.mktemp("jobs") / "known", *ROLLOUT, *own)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return [
        "tracking.enabled=true",
        f"tracking.uri=sqlite:///{tmp_path_factory.mktemp('store')}/a.db",
    ]


@pytest.fixture(scope="module")
def one_for_all(tmp_path_factory: pytest.TempPathFactory, store: list[str]) -> cfx.plugin.Result:
    """A tracked job without a population, whose policy answers parameters."""
    folder = tmp_path_factory.mktemp("jobs") / "one"
    return cfx.run([*TRAINED, "protocol.networks=all", f"hydra.run.dir={folder}", *store])


@pytest.fixture(scope="module")
def of_all(
    tmp_path_factory: pytest.TempPathFactory, one_for_all: cfx.plugin.Result
) -> cfx.plugin.Result:
    """A job that drives its policy."""
    return transferred(one_for_all.folder, tmp_path_factory.mktemp("of all"))


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory, unseen: Path) -> cfx.plugin.Result:
    """A job in which a policy drives that knows nothing of its drivers."""
    return transferred(unseen, tmp_path_factory.mktemp("moved"))


@pytest.fixture(scope="module")
def saved(unseen: Path) -> Transfer:
    return Transfer(run=unseen)


def test_contract(saved: Transfer) -> None:
    check_contract(saved)


def elsewhere(seed: int = 9) -> PairSet:
    return SyntheticDataset(pairs=3, platoon_size=1, frames=200, seed=seed).load()


def transferred(run: Path, tmp_path: Path, *overrides: str) -> cfx.plugin.Result:
    return cfx.run([*HERE, f"protocol.run={run}", f"hydra.run.dir={tmp_path / 'job'}", *overrides])


def test_it_drives_with_the_network_of_all_from_the_populations_parameters(
    unseen: Path, moved: cfx.plugin.Result
) -> None:
    result = moved
    policy = checkpoint.load_agent(unseen / "policy")
    batch = PairBatch.of(elsewhere())
    number = torch.full((3,), policy.names.index(ANY_DRIVER))
    model = cfx.get("model", "krauss")()
    loop = simulate_closed_loop(
        MemoryStepper(model, 0.1),
        policy,
        Followers(batch, number),
        torch.zeros(3, dtype=torch.int64),
    )
    error = loop.speed - batch.follower_speed[:, : loop.speed.shape[1]]
    rows = result.pairs[result.pairs.method == "policy"]
    torch.testing.assert_close(
        torch.tensor(rows["full_trajectory_rmse_speed"].to_numpy()),
        error[:, 1:].square().mean(1).sqrt(),
    )
    assert policy.pooled is not None
    population = result.pairs[result.pairs.method == "pooled"][
        ["parameter_t_r", "parameter_t_i"]
    ].to_numpy()
    torch.testing.assert_close(torch.tensor(population), policy.pooled[number])


def test_it_starts_from_drivers_own_parameters_where_it_learned_so(
    known: Path, moved: cfx.plugin.Result, tmp_path: Path
) -> None:
    """They are those of the model alone, also where the policy has a residual."""
    metrics = transferred(known, tmp_path / "known").metrics
    assert metrics["rmse_speed/shrunk"] != metrics["rmse_speed/driver_specific"]
    assert metrics["rmse_speed/policy"] > 0.0
    assert "rmse_speed/shrunk" not in moved.metrics


def test_model_policy_and_windows_are_those_it_was_trained_with_and_drivers_of_the_same_names_count(
    unseen: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("WARNING"):  # all synthetic recordings are called synthetic
        result = transferred(unseen, tmp_path, "model=w99", "policy=lstm", "windows.length=7")
    assert "3 drivers have the same names, including the recording" in caplog.text
    config = yaml.safe_load((result.folder / "config.yaml").read_text())
    assert (config["model"]["name"], config["policy"]["name"], config["windows"]["length"]) == (
        "krauss",
        "gru",
        5,
    )
    assert config["policy"]["inputs"] == "situation"
    notes = json.loads((result.folder / "data.json").read_text())["protocol"]
    assert notes["pairs_learned_from"] == 6
    assert notes["drivers_named_as_some_learned_from"] == 3


def test_the_job_may_be_named_by_its_mlflow_run(
    one_for_all: cfx.plugin.Result, of_all: cfx.plugin.Result, store: list[str], tmp_path: Path
) -> None:
    run = one_for_all.run_id
    named = cfx.run([*HERE, f"protocol.run={run}", f"hydra.run.dir={tmp_path / 'by id'}", *store])
    pd.testing.assert_frame_equal(named.pairs, of_all.pairs)
    config = yaml.safe_load((named.folder / "config.yaml").read_text())
    assert config["protocol"]["run"] == run
    nowhere = [f"protocol.run={'f' * 32}", f"hydra.run.dir={tmp_path / 'nothing'}"]
    with pytest.raises(TrackingError, match=r"could not read run f{32}"):
        cfx.run([*HERE, *nowhere, *store])


def test_without_a_population_the_default_is_the_only_baseline_for_unseen_drivers(
    of_all: cfx.plugin.Result,
) -> None:
    result = of_all
    assert set(result.pairs.method) == {"default", "driver_specific", "policy"}
    assert result.pairs[result.pairs.method == "policy"]["full_trajectory_rmse_speed"].notna().all()


def test_what_it_has_learned_from_is_refused_whatever_it_is_called(
    unseen: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        DataError, match=r"has learned from 3 of the 3 pairs in .*, the first of them 'synthetic-"
    ):
        transferred(unseen, tmp_path, "data.seed=5", "data.pairs=6", "data.max_pairs=3")
    seen = SyntheticDataset(pairs=6, platoon_size=1, frames=200, seed=5).load()
    renamed = tuple(
        replace(pair, recording="other", pair_id=f"x{pair.pair_id}", truth={}) for pair in seen[:4]
    )
    write_tidy(PairSet((*renamed, *elsewhere()), "both"), tmp_path / "renamed.csv")
    again = TidyDataset(path=tmp_path / "renamed.csv", min_duration=10).load()
    with pytest.raises(DataError, match="has learned from 4 of the 7 pairs"):
        Transfer(run=unseen).finished.check(again)


def test_other_units_and_fewer_decimals_do_not_hide_what_it_has_learned_from(
    unseen: Path, tmp_path: Path
) -> None:
    """The same pairs through km/h, and saved with two decimals."""
    seen = SyntheticDataset(pairs=6, platoon_size=1, frames=200, seed=5).load()
    table = frame_of(PairSet(tuple(replace(pair, recording="other") for pair in seen), "seen"))
    speeds = ["leader_speed_mps", "follower_speed_mps"]
    for name, saved in {
        "kmh": table.assign(**{column: table[column] * 3.6 / 3.6 for column in speeds}),
        "rounded": table.round(2),
    }.items():
        path = tmp_path / f"{name}.csv"
        saved.to_csv(path, index=False)
        with pytest.raises(DataError, match="has learned from 6 of the 6 pairs"):
            Transfer(run=unseen).finished.check(TidyDataset(path=path, min_duration=0).load())


def test_constant_parameters_are_not_tested_on_whom_they_were_calibrated_on(tmp_path: Path) -> None:
    constant = trained(
        tmp_path / "constant", "policy=fixed", "protocol=across_drivers", "protocol.folds=2"
    )
    seen = SyntheticDataset(pairs=6, platoon_size=1, frames=200, seed=5, max_pairs=3).load()
    with pytest.raises(DataError, match="has learned from 3 of the 3 pairs"):
        Transfer(run=constant).finished.check(seen)
    there = transferred(constant, tmp_path)
    assert set(there.pairs["method"]) == {"default", "pooled", "driver_specific"}


def test_other_time_steps_are_refused(saved: Transfer) -> None:
    pairs = elsewhere()
    fast = PairSet(tuple(replace(pair, dt=0.05) for pair in pairs), "fast")
    said = r"drives in steps of 0.1 s, fast has 0.05 s; set data.time_step=0.1"
    with pytest.raises(DataError, match=said):
        saved.finished.check(fast)
    saved.finished.check(pairs)


def test_runs_that_have_no_policy_for_others_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"protocol\.run=.*nowhere: .*nowhere/policy holds no policy"
    ):
        transferred(tmp_path / "nowhere", tmp_path)
    per_pair = trained(tmp_path / "pairs", "data.pairs=2")
    with pytest.raises(
        DataError,
        match=r"protocol\.run=.*pairs: the policy has 2 networks, one for each of its own pairs",
    ):
        transferred(per_pair, tmp_path)
    with pytest.raises(CfxError, match=r"protocol\.run: a value is required"):
        cfx.run([*HERE, f"hydra.run.dir={tmp_path / 'job'}"])


def test_a_job_that_drives_a_saved_policy_hands_it_on(
    unseen: Path, moved: cfx.plugin.Result, tmp_path: Path
) -> None:
    twice = transferred(moved.folder, tmp_path)
    pd.testing.assert_frame_equal(twice.pairs, moved.pairs)
    assert (
        checkpoint.load_agent(twice.folder / "policy").trained_on.pairs
        == checkpoint.load_agent(unseen / "policy").trained_on.pairs
    )
