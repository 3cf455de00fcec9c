"""Synthetic platoons: plausible, repeatable, and true to the parameters they claim."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import torch

from cfx.data.pairs import Pair, PairSet
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Leader
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.synthetic import SyntheticDataset, leader_speed, smooth_noise
from cfx.simulation.trajectory import Start, Trajectory

MODELS: dict[str, type[DrivingModel]] = {"krauss": Krauss, "w99": W99, "idm": IDM}


DIVERSE = {"seed": 5, "pairs": 12, "platoon_size": 4, "frames": 400}
DIVERSE |= {"heterogeneity": 1.0, "variation": 1.0}


@functools.cache
def made(**options: Any) -> PairSet:
    return SyntheticDataset(**{"pairs": 6, "platoon_size": 3, "frames": 201, **options}).load()


def driven_again(pair: Pair) -> Trajectory:
    model = MODELS[pair.truth_model]()
    hold = round(0.5 / pair.dt)
    parameters = torch.tensor(
        np.stack([pair.truth[name][::hold] for name in model.space.names], -1)
    )
    leader = Leader(
        *(
            torch.tensor(x)
            for x in (pair.leader_position, pair.leader_speed, pair.leader_acceleration)
        ),
        torch.tensor(pair.leader_length, dtype=torch.float64),
    )
    start = Start(
        *(
            torch.tensor(x[0])
            for x in (pair.follower_position, pair.follower_speed, pair.follower_acceleration)
        )
    )
    return simulate_follower(model, parameters, leader, start, pair.dt, window=hold)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dt", [0.1, 0.2])
def test_true_parameters_give_the_recorded_drive_again(model: str, dt: float) -> None:
    for pair in made(model=model, **({} if dt == 0.1 else {"dt": dt})):
        again = driven_again(pair)
        np.testing.assert_allclose(
            again.position.numpy(), pair.follower_position, rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(again.speed.numpy(), pair.follower_speed, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_positions_speeds_and_accelerations_belong_together(model: str) -> None:
    for pair in made(model=model):
        for who in ("leader", "follower"):
            position, speed, acceleration = (
                getattr(pair, f"{who}_{name}") for name in ("position", "speed", "acceleration")
            )
            np.testing.assert_allclose(np.diff(position), speed[1:] * pair.dt, atol=1e-9)
            np.testing.assert_allclose(np.diff(speed) / pair.dt, acceleration[1:], atol=1e-9)


def test_each_follower_leads_the_next() -> None:
    pairs = made()
    assert [(pair.leader_id, pair.follower_id) for pair in pairs] == [
        *(("1", "2"), ("2", "3"), ("3", "4"), ("5", "6"), ("6", "7"), ("7", "8")),
    ]
    for front, back in ((pairs[0], pairs[1]), (pairs[1], pairs[2])):
        np.testing.assert_array_equal(front.follower_position, back.leader_position)
        np.testing.assert_array_equal(front.follower_speed, back.leader_speed)


@pytest.mark.parametrize("model", MODELS)
def test_traffic_is_plausible(model: str) -> None:
    pairs = made(model=model, pairs=36, platoon_size=4, frames=600)
    speed = np.concatenate([pair.follower_speed for pair in pairs])
    acceleration = np.concatenate([pair.follower_acceleration for pair in pairs])
    assert len(pairs) == 36
    assert speed.min() >= 0
    assert speed.max() < 25
    assert np.abs(acceleration).max() < 5
    assert min(pair.gap.min() for pair in pairs) > 0
    assert np.median([pair.follower_speed.std() for pair in pairs]) > 1.0, (
        "stop and go, not a steady flow"
    )


@pytest.mark.parametrize("model", MODELS)
def test_the_most_diverse_drivers_do_not_collide(model: str) -> None:
    pairs = made(model=model, **DIVERSE)
    assert min(pair.gap.min() for pair in pairs) > 0
    assert max(np.abs(pair.follower_acceleration).max() for pair in pairs) < 9 + 1e-6


def test_leaders_keep_to_bounded_acceleration_and_jerk() -> None:
    speed = leader_speed(200, 3000, 0.1, np.random.default_rng(0))
    acceleration = np.diff(speed) / 0.1
    assert speed.min() >= 0
    assert acceleration.max() <= 1.8 + 1e-9
    assert acceleration.min() >= -2.5 - 1e-9
    assert np.abs(np.diff(acceleration)).max() <= 1.5 * 0.1 + 1e-9
    assert (speed < 5).any(axis=1).mean() > 0.95, "nearly every leader meets a wave in five minutes"


def test_smooth_noise_is_standard_and_smooth() -> None:
    noise = smooth_noise((400,), 200, 1 / 16, np.random.default_rng(0))
    assert abs(noise.mean()) < 0.1
    assert noise.std() == pytest.approx(1, abs=0.05)
    assert noise[:, 0].std() == pytest.approx(1, abs=0.1), "stationary from the start"
    assert np.abs(np.diff(noise)).std() < 0.1


@pytest.mark.parametrize("model", MODELS)
def test_true_parameters_vary_as_asked_and_stay_in_bounds(model: str) -> None:
    space = MODELS[model]().space
    for pair in made(model=model, **DIVERSE):
        assert tuple(pair.truth) == space.names
        for name, values in pair.truth.items():
            assert values.shape == (400,)
            assert values.min() >= space[name].low
            assert values.max() <= space[name].high
            assert (np.diff(values).reshape(-1)[np.arange(399) % 5 != 4] == 0).all(), (
                "held for half a second"
            )
            assert values.std() > 0
    for pair in made(model=model, variation=0.0, heterogeneity=0.0, frames=20, min_duration=0):
        for name, values in pair.truth.items():
            assert values == pytest.approx(space[name].default)
            assert np.ptp(values) == 0


def test_the_seed_decides() -> None:
    first, again, other = (
        SyntheticDataset(pairs=3, frames=60, seed=seed, min_duration=0).load() for seed in (0, 0, 1)
    )
    assert first.fingerprint == again.fingerprint != other.fingerprint


def test_noise_belongs_to_the_vehicle_and_leaves_the_truth_alone() -> None:
    clean, noisy = made(frames=300), made(frames=300, noise_position_m=0.2, noise_speed_mps=0.1)
    for one, other in zip(clean, noisy, strict=True):
        assert (other.follower_position - one.follower_position).std() == pytest.approx(
            0.2, rel=0.15
        )
        assert (other.follower_speed - one.follower_speed).std() == pytest.approx(0.1, rel=0.15)
        np.testing.assert_allclose(
            np.diff(other.follower_speed) / 0.1, other.follower_acceleration[1:], atol=1e-9
        )
        for name in one.truth:
            np.testing.assert_array_equal(one.truth[name], other.truth[name])
    np.testing.assert_array_equal(noisy[0].follower_position, noisy[1].leader_position)
    assert min(pair.follower_speed.min() for pair in noisy) >= 0


def test_pairs_that_noise_turns_around_are_counted() -> None:
    pairs = SyntheticDataset(pairs=8, frames=300, noise_position_m=6.0, min_duration=0).read()
    (dropped,) = pairs.dropped
    assert len(pairs) + dropped.count == 8
    assert "noise" in dropped.reason


@pytest.mark.parametrize(
    "options", [{"model": "w74"}, {"variation": 1.5}, {"pairs": 0}, {"dt": 0.0}, {"seed": -1}]
)
def test_refuses_settings_that_make_no_sense(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        SyntheticDataset(**options)
