"""What drivers' pasts say: shares of the policy, and bounds of errors to come."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.optimize import minimize_scalar

import cfx
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.errors import ConfigError, DataError
from cfx.evaluation.closed_loop import Followers
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.evaluation.protocols.past import PastErrors, past_errors, with_bounds_of_other_folds
from cfx.evaluation.result import Array, Evaluation
from cfx.policies.agent import Agent
from cfx.policies.checkpoint import load_agent
from cfx.policies.known_drivers import driver_features_of, unlikeness
from cfx.policies.ready import folder_of_ready_made
from cfx.results.tables.past import Past
from tests.drives import straight_pairs

QUICK = [
    "debug=quick",
    "protocol=across_drivers",
    "protocol.folds=2",
    "protocol.histories=[]",
    "data.max_pairs=null",
    "data.pairs=16",
    "data.platoon_size=1",
    "data.frames=130",
    "figures=none",
    "tracking.enabled=false",
]


def test_the_share_is_the_least_squares_one_drawn_to_a_half() -> None:
    """Against SciPy's minimum of the sum that the share is said to minimise."""
    draw = np.random.default_rng(0).normal(size=(2, 40, 300))
    own, policy = draw[0] + 0.5 * draw[1], 0.7 * draw[1]
    past = PastErrors(
        (own**2).mean(1), (policy**2).mean(1), (own * policy).mean(1), (own**2).mean(1)
    )
    for driver in range(40):
        o, p = own[driver], policy[driver]
        pull = ((o**2).mean() + (p**2).mean()) / 2

        def cost(w: float, o: Array = o, p: Array = p, pull: float = pull) -> float:
            return float(((w * p + (1 - w) * o) ** 2).mean() + pull * (w - 0.5) ** 2)

        best = minimize_scalar(cost, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-9})
        assert past.weight[driver] == pytest.approx(best.x, abs=1e-5)
        mean = past.weight[driver] * p + (1 - past.weight[driver]) * o
        assert past.both[driver] == pytest.approx((mean**2).mean() ** 0.5)


def test_a_past_without_errors_or_too_short_says_what_it_can() -> None:
    own, policy = np.array([0.0, np.nan, 1.0]), np.array([0.0, np.nan, 1.0])
    past = PastErrors(own, policy, own, own)
    np.testing.assert_allclose(past.weight, [0.5, 1.0, 0.5])
    assert np.isnan(past.both[1])


@pytest.mark.parametrize(("frames", "stride"), [(69, 5), (90, 60)])
def test_a_past_whose_parts_are_shorter_than_three_seconds_says_nothing(
    frames: int, stride: int
) -> None:
    # 6.9 s are divided into 4 and 2.9 s; of 9 s no window of 6 s lies within the first 5.4 s.
    pairs = straight_pairs([100])
    batch = PairBatch.of(pairs)
    context = cast(ProtocolContext, SimpleNamespace(windows=SimpleNamespace(stride=stride)))
    followers = Followers(batch, torch.zeros(1, dtype=torch.int64))
    policy = cast(Agent, None)
    past = past_errors(context, policy, pairs, followers, torch.tensor([frames]))
    assert np.isnan(past.both).all()


def test_bounds_know_nothing_of_the_driver_that_they_are_for() -> None:
    columns = ["past_rmse_speed_policy", "past_rmse_speed_driver_specific"]
    table = pd.DataFrame({name: np.ones(24) for name in columns})
    fold = np.repeat([0, 1], 12)
    for method, growth in (("policy", 2.0), ("driver_specific", 3.0)):
        table[f"rmse_speed_{method}"] = np.where(fold == 0, growth, 10.0 * growth)
    bounds = with_bounds_of_other_folds(table, fold)
    assert set(bounds["bound_policy"][fold == 0]) == {20.0}
    assert set(bounds["bound_policy"][fold == 1]) == {2.0}
    assert set(bounds["bound_driver_specific"][fold == 1]) == {3.0}


def test_a_policy_that_combines_does_so_wherever_it_is_tested(tmp_path: Path) -> None:
    folder = tmp_path / "job"
    learned = cfx.run([*QUICK, "protocol.combine=true", f"hydra.run.dir={folder}"])
    past = pd.read_csv(folder / "past.csv")
    assert len(past) == 16
    assert past["share"].between(0.0, 1.0).all()
    pairs = learned.pairs.set_index(["pair_id", "method"])["rmse_speed"]
    for method in ("policy", "driver_specific"):
        found = pairs.xs(method, level="method")[past["pair_id"]]
        np.testing.assert_allclose(found, past[f"rmse_speed_{method}"])
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["past/share"] == pytest.approx(past["share"].mean())
    agent = load_agent(folder / "policy")
    assert agent.context_rule.combines
    expected = agent.trained_on.expected_error
    assert expected is not None
    growth = past["rmse_speed_policy"] / past["past_rmse_speed_policy"]
    assert expected.policy == pytest.approx(growth.max())
    full = learned.pairs.groupby("method")["full_trajectory_rmse_speed"].max()
    assert expected.unseen == pytest.approx(full["policy"])
    assert expected.unseen_constant == pytest.approx(full["pooled"])
    other = tmp_path / "other"
    cfx.run(
        [
            *(one for one in QUICK if not one.startswith("protocol")),
            "data.seed=7",
            "protocol=transfer",
            f"protocol.run={folder}",
            f"hydra.run.dir={other}",
        ]
    )
    elsewhere = pd.read_csv(other / "past.csv")
    bounds = expected.policy * elsewhere["past_rmse_speed_policy"]
    np.testing.assert_allclose(elsewhere["bound_policy"], bounds)


def test_drivers_are_unlike_those_learned_from_by_standard_deviations() -> None:
    agent = load_agent(folder_of_ready_made("cfx://idm-history") / "policy").for_unseen_drivers()
    count = len(agent.core.driver_features)
    mean, scale = (
        agent.core.scaler.mean[0, -count:].double(),
        agent.core.scaler.scale[0, -count:].double(),
    )
    away = torch.tensor([0.0, 1.0, -2.0, 5.0, 0.5, float("nan")], dtype=torch.float64)
    network = torch.zeros(1, dtype=torch.int64)
    found = unlikeness(agent, (mean + away * scale)[None], network)
    torch.testing.assert_close(found[0], away, equal_nan=True)


def test_drivers_unlike_those_learned_from_are_counted() -> None:
    errors = {"share": 1.0, "rmse_speed_alone": 1.0, "past_rmse_speed_alone": 1.0}
    errors |= {
        f"{part}_{method}": 1.0 for part in _PARTS for method in ("policy", "driver_specific")
    }
    table = pd.DataFrame(errors, index=range(5)).assign(
        unlike=[0.5, 3.5, 4.0, 2.9, np.nan],
        unlike_in=["acceleration", "time_gap", "time_gap", "acceleration", ""],
    )
    evaluation = cast(Evaluation, SimpleNamespace(tables={"past": table}))
    metrics = Past().metrics(evaluation)
    assert metrics["past/unlike"] == 0.5
    words = " ".join(Past().console(evaluation, metrics))
    assert (
        "2 of 4 drivers drive unlike those that it learned from, most often in their time gap"
        in words
    )


_PARTS = ("past_rmse_speed", "rmse_speed", "bound")


def test_a_motorway_is_unlike_the_congestion_that_was_learned_from(shared_data: Path) -> None:
    agent = load_agent(folder_of_ready_made("cfx://idm-history") / "policy").for_unseen_drivers()
    count = len(agent.core.driver_features)
    features = {}
    for name in ("i80_reconstructed", "openacc_vicolungo"):
        pairs = TidyDataset(path=str(shared_data / f"{name}_pairs.parquet"), min_duration=30).load()
        batch = PairBatch.of(pairs)
        found = driver_features_of(agent, batch, (0.8 * batch.lengths).long())
        assert found is not None
        features[name] = found
    congestion = features["i80_reconstructed"].numpy()
    agent.core.scaler.mean[0, -count:] = torch.from_numpy(np.nanmean(congestion, 0))
    agent.core.scaler.scale[0, -count:] = torch.from_numpy(np.nanstd(congestion, 0))
    unlike = {}
    for name, of_drivers in features.items():
        network = torch.zeros(len(of_drivers), dtype=torch.int64)
        away = unlikeness(agent, of_drivers, network).abs()
        unlike[name] = float((away.max(1).values > 3).double().mean())
    assert unlike["i80_reconstructed"] < 0.1
    assert unlike["openacc_vicolungo"] > 0.75


def test_a_driver_without_a_past_has_no_own_parameters() -> None:
    with pytest.raises(ConfigError, match=r"combine: .*leave history: null"):
        cfx.run([*QUICK, "protocol.combine=true", "protocol.history=0.0"])


def test_networks_do_not_begin_with_what_is_tested(tmp_path: Path) -> None:
    folder = tmp_path / "job"
    few = [*QUICK, "data.pairs=4"]
    cfx.run([*few, f"hydra.run.dir={folder}"])
    with pytest.raises(DataError, match=r"learner\.start: .* has learned from 4 of the 4 pairs"):
        cfx.run([*few, "learner=rollout", f"learner.start={folder}"])
