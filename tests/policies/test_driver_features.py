"""Driver features: measured from a driver's history alone, or unknown."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from sklearn.linear_model import Ridge

import cfx
from cfx.data.pairs import PairBatch
from cfx.data.tidy import write_tidy
from cfx.errors import ConfigError
from cfx.models.krauss import Krauss
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.context import DriverContext
from cfx.policies.driver_features import DRIVER_FEATURES, LEAST, MOVING, measure
from cfx.policies.gru import GruPolicy
from cfx.policies.history import measured_history
from cfx.policies.known_drivers import driver_features_of
from cfx.policies.prediction import predict_frame
from tests.agents import adaptive
from tests.drives import straight_pairs, wavy_pairs
from tests.histories import observed

ALL = tuple(DRIVER_FEATURES)
PARAMETERS = torch.tensor([[1.0, 0.1], [1.8, 0.5], [3.0, 0.4]]).double()
BATCH = PairBatch.of(wavy_pairs(Krauss(), PARAMETERS, frames=300))
frame = st.integers(0, 299)


def measured(
    batch: PairBatch, since: int, until: int, names: tuple[str, ...] = ALL
) -> torch.Tensor:
    pairs = len(batch)
    return measure(batch, names, 0.1, torch.full((pairs,), since), torch.full((pairs,), until))


def by_hand(pair: int, since: int, until: int) -> dict[str, float]:
    """The same with NumPy, and scikit-learn's ridge regression around a slope of 1.2 s."""
    speed, leader, acceleration, gap = (
        signal[pair, since:until].double().numpy()
        for signal in (
            BATCH.follower_speed,
            BATCH.leader_speed,
            BATCH.follower_acceleration,
            BATCH.gap,
        )
    )
    moving = speed > MOVING
    if moving.sum() * 0.1 < LEAST:
        return dict.fromkeys(ALL, math.nan)
    headway = np.log(np.maximum(gap[moving], 0.5) / speed[moving])
    ridge = Ridge(alpha=2.0 * len(speed)).fit(speed[:, None], gap - 1.2 * speed)
    rms = [
        math.log(np.sqrt(np.mean(signal**2)) + 0.05) for signal in (leader - speed, acceleration)
    ]
    return {
        "time_headway": float(headway.mean()),
        "time_gap": 1.2 + float(ridge.coef_[0]),
        "standstill_gap": float(ridge.intercept_),
        "speed_difference": rms[0],
        "acceleration": rms[1],
    }


@settings(deadline=None)
@given(frame, frame, st.integers(0, 2))
def test_any_part_has_the_features_of_its_frames(one: int, other: int, pair: int) -> None:
    since, until = sorted((one, other))
    found = dict(zip(ALL, measured(BATCH, since, until)[pair].tolist(), strict=True))
    expected = by_hand(pair, since, until)
    assert {name: found[name] for name in expected} == pytest.approx(
        expected, rel=1e-6, abs=1e-6, nan_ok=True
    )


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.4])
def test_the_response_time_is_the_delay_with_which_the_leader_is_repeated(delay: float) -> None:
    frames = round(delay * 10)
    speed = BATCH.leader_speed.roll(frames, 1)
    speed[:, :frames] = BATCH.leader_speed[:, :1]
    late = replace(BATCH, follower_speed=speed + 0.5)
    found = measure(late, ("response_time",), 0.1, torch.full((3,), frames), torch.full((3,), 300))
    assert found[:, 0].tolist() == pytest.approx([delay] * 3, abs=0.15)


@settings(deadline=None)
@given(frame, st.sampled_from(ALL))
def test_what_is_still_to_come_tells_nothing(until: int, name: str) -> None:
    steady = torch.arange(BATCH.mask.shape[1]) >= until
    signals = (
        "leader_speed",
        "leader_acceleration",
        "follower_speed",
        "follower_acceleration",
        "leader_position",
    )
    other = replace(BATCH, **{signal: getattr(BATCH, signal) + 7.0 * steady for signal in signals})
    one, same = (measured(batch, 0, until, (name,)) for batch in (BATCH, other))
    torch.testing.assert_close(one, same, rtol=0, atol=0, equal_nan=True)


def test_who_was_hardly_measured_or_stood_is_unknown() -> None:
    moving, standing = (PairBatch.of(straight_pairs([400], speed)) for speed in (10.0, 1.0))
    assert not bool(measured(moving, 0, 150).isnan().any())
    assert bool(measured(moving, 0, 149).isnan().all())
    assert bool(measured(moving, 100, 249).isnan().all())
    assert bool(measured(standing, 0, 400).isnan().all())
    still = [math.log(2.0), 1.2, 8.0, math.log(0.05), math.log(0.05)]
    assert measured(moving, 0, 200)[0, :-1].tolist() == pytest.approx(still, abs=1e-9)


def one_that_knows() -> Agent:
    """Two networks for whom an unknown driver feature is 6, the mean of those they learned from."""
    return adaptive(
        {"name": "krauss"},
        ("one", "all"),
        offsets=True,
        driver_features=("time_headway", "acceleration"),
    )


def first_answer(policy: Agent, driver_features: list[float] | None) -> list[float]:
    now = observed(
        *(
            torch.full((1, policy.windows.length), value).double()
            for value in (8.0, 0.1, 9.0, -0.2, 15.0)
        )
    )
    features = None if driver_features is None else torch.tensor([driver_features]).double()
    return policy.act(
        now, policy.begin(torch.ones(1, dtype=torch.long), DriverContext(None, features))
    )[0][0].tolist()


def test_the_mean_of_the_training_drivers_stands_for_an_unseen_driver() -> None:
    policy = one_that_knows()
    cold_start = first_answer(policy, None)
    assert (
        cold_start == first_answer(policy, [6.0, 6.0]) == first_answer(policy, [math.nan, math.nan])
    )
    assert cold_start != pytest.approx(first_answer(policy, [0.7, -0.5]), rel=1e-4)
    assert first_answer(policy, [math.nan, -0.5]) == first_answer(policy, [6.0, -0.5])


def test_a_saved_policy_uses_the_same_driver_features(tmp_path: Path) -> None:
    policy = one_that_knows()
    checkpoint.save_agent(policy, tmp_path)
    for again in (
        checkpoint.load_agent(tmp_path),
        checkpoint.load_agent(tmp_path).for_unseen_drivers(),
    ):
        now = observed(
            *(torch.full((1, 5), value).double() for value in (8.0, 0.1, 9.0, -0.2, 15.0))
        )
        network = torch.tensor([len(again.names) - 1])
        answer, _ = again.act(
            now, again.begin(network, DriverContext(None, torch.tensor([[0.7, -0.5]]).double()))
        )
        assert answer[0].tolist() == pytest.approx(first_answer(policy, [0.7, -0.5]), rel=1e-6)


def test_a_table_is_answered_with_its_drivers_features(tmp_path: Path) -> None:
    write_tidy(wavy_pairs(Krauss(), PARAMETERS, frames=300), tmp_path / "pairs.parquet")
    table = pd.read_parquet(tmp_path / "pairs.parquet")
    policy = adaptive({"name": "krauss"}, driver_features=("time_headway", "response_time"))
    until, network = BATCH.lengths - 1, torch.zeros(3, dtype=torch.long)
    chosen = {}
    for driver_features in (driver_features_of(policy, BATCH, until), None):
        state = policy.burn_in(
            BATCH, until, policy.begin(network, DriverContext(None, driver_features))
        )
        now = measured_history(BATCH, torch.arange(3), until, policy.windows.length)
        chosen[driver_features is None] = policy.act(now, state)[0][:, 0].tolist()
    found = predict_frame(policy, table)["t_r"].tolist()
    assert found == pytest.approx(chosen[False], rel=1e-6)
    assert found != pytest.approx(chosen[True], rel=1e-3)


def test_the_history_that_is_observed_is_the_history_that_is_measured() -> None:
    policy, until = one_that_knows(), torch.tensor([290, 290, 290])
    names = ("time_headway", "acceleration")
    torch.testing.assert_close(
        driver_features_of(policy, BATCH, until, until - 210), measured(BATCH, 80, 290, names)
    )
    torch.testing.assert_close(
        driver_features_of(policy, BATCH, until), measured(BATCH, 0, 290, names)
    )
    nothing = driver_features_of(policy, BATCH, until, until)
    assert nothing is not None
    assert bool(nothing.isnan().all())
    assert driver_features_of(adaptive({"name": "krauss"}), BATCH, until) is None


def test_an_unknown_driver_feature_is_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"policy.driver_features=\('time_headwy',\): unknown driver feature 'time_headwy'."
        r" Did you mean 'time_headway'",
    ):
        GruPolicy(driver_features=("time_headwy",))
    with pytest.raises(
        ConfigError,
        match=r"policy.driver_features=.*: one driver feature stands twice in time_gap, time_gap",
    ):
        GruPolicy(driver_features=("time_gap", "time_gap"))
    with pytest.raises(
        (ConfigError, ValidationError), match=r"not a set of driver features. Write \[time_gap\]"
    ):
        GruPolicy(driver_features="time_gap")
    assert GruPolicy(driver_features="all").driver_features == ALL
    assert GruPolicy(driver_features="none").driver_features == ()


def test_a_learner_without_conditioning_refuses_driver_features(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"policy.driver_features=\['time_gap'\]: this learner provides no driver features",
    ):
        cfx.run(
            [
                "debug=quick",
                "policy.driver_features=[time_gap]",
                "tracking.enabled=false",
                f"hydra.run.dir={tmp_path / 'job'}",
            ]
        )
    assert not (tmp_path / "job" / "pairs.csv").exists()
