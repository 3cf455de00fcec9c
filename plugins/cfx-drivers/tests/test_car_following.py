"""Environments of car following: Gymnasium's rules, cfx's closed loop, one batch as each alone."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import cfx_drivers.gym
from cfx.errors import ConfigError, DataError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.models.krauss import Krauss
from cfx.plugin import PairBatch, PairSet
from cfx.simulation.rollout import MemoryStepper
from cfx_drivers.gym.vector import COLLISION, CarFollowingVectorEnv, Outcome
from tests.agents import adaptive
from tests.drives import straight_pairs, wavy_pairs

gymnasium.register_envs(cfx_drivers.gym)
TRUE = torch.tensor([[1.5, 0.1], [2.5, 0.4], [2.0, 0.0]], dtype=torch.float64)
PAIRS = wavy_pairs(Krauss(), TRUE, frames=60)
AGENT = adaptive({"name": "krauss"}, offsets=True)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space")  # actions are in m/s2
@pytest.mark.parametrize("followers", [0, 2])
def test_it_keeps_gymnasiums_rules(followers: int) -> None:
    env = gymnasium.make(
        "cfx/CarFollowing-v0",
        recording=PAIRS,
        driver=AGENT if followers else None,
        followers=followers,
        render_mode="rgb_array",
    )
    check_env(env.unwrapped)


def test_an_ego_that_drives_as_recorded_sees_what_was_recorded() -> None:
    env = CarFollowingVectorEnv(3, recording=PAIRS)
    batch = PairBatch.of(PAIRS)
    env.reset(seed=0)
    for number, pair in enumerate(PAIRS):
        observation, information = env.reset(options={"pair": pair.pair_id})
        assert (information["pair"] == number).all()
        for frame in range(1, len(pair)):
            wanted = batch.follower_acceleration[number, frame]
            observation, reward, terminated, truncated, _ = env.step(np.full((3, 1), float(wanted)))
            np.testing.assert_allclose(reward, 0.0, atol=1e-9)
            np.testing.assert_allclose(
                observation[0], _recorded(batch, number, frame), rtol=1e-5, atol=1e-5
            )
            assert not terminated.any()
            assert (truncated == (frame == len(pair) - 1)).all()


def _recorded(batch: PairBatch, pair: int, frame: int) -> NDArray[np.float64]:
    at = (pair, frame)
    signals = [
        batch.follower_speed[at],
        batch.follower_acceleration[at],
        batch.gap[at],
        batch.leader_speed[at],
        batch.leader_acceleration[at],
    ]
    return torch.stack(signals).numpy()


def test_drivers_behind_drive_as_evaluation_does_behind_the_ego() -> None:
    """The ego drives steadily, so that evaluation may take it for a recorded leader."""
    pairs = straight_pairs([80], speed=12.0)
    env = CarFollowingVectorEnv(2, recording=pairs, driver=AGENT)
    observation, _ = env.reset(seed=1)
    speeds = [observation[0, 6]]
    for _ in range(78):
        observation, *_ = env.step(np.zeros((2, 1)))
        speeds.append(observation[0, 6])
    zeros = torch.zeros(1, dtype=torch.int64)
    stepper = MemoryStepper(Krauss(), 0.1, compile="never")
    expected = simulate_closed_loop(stepper, AGENT, Followers(PairBatch.of(pairs), zeros), zeros)
    np.testing.assert_allclose(speeds, expected.speed[0, :79].numpy(), rtol=0, atol=1e-5)


def test_an_action_that_is_no_number_is_refused() -> None:
    env = CarFollowingVectorEnv(2, recording=PAIRS)
    env.reset(seed=0)
    with pytest.raises(DataError, match=r"the action of environment 1 is not a number \(NaN\)"):
        env.step(np.array([[0.5], [np.nan]]))
    assert np.isfinite(env.step(np.zeros((2, 1)))[0]).all()


def test_drivers_react_to_the_ego() -> None:
    env = CarFollowingVectorEnv(2, recording=PAIRS, driver=AGENT, followers=3)
    env.reset(options={"pair": "p0"})
    action = np.array([[0.0], [-1.5]])
    for _ in range(25):
        observation, _, _, _, information = env.step(action)
    follower_speed = env.observed.index("follower_speed")
    assert observation[1, follower_speed] < observation[0, follower_speed] - 0.2
    assert information["hardest_braking"][1] > 0.2


def test_a_collision_ends_an_episode_and_the_next_step_begins_another() -> None:
    env = CarFollowingVectorEnv(2, recording=straight_pairs([200, 300]))
    env.reset(seed=0)
    action = np.array([[2.6], [0.0]])
    for _ in range(150):
        observation, reward, terminated, _, information = env.step(action)
        if terminated.any():
            break
    assert terminated.tolist() == [True, False]
    assert information["collided"].tolist() == [True, False]
    assert reward[0] == COLLISION
    assert observation[0, 2] < 0
    observation, reward, terminated, _, information = env.step(action)
    assert (reward[0], bool(terminated[0]), information["time_s"][0]) == (0.0, False, 0.0)
    assert observation[0, 2] == 20.0
    assert information["time_s"][1] > 0.0


def test_a_batch_is_each_alone_and_a_seed_gives_the_same_episodes() -> None:
    stochastic = adaptive({"name": "krauss"}, stochastic=True)

    def run(count: int, agent: object) -> NDArray[np.float64]:
        env = gymnasium.make_vec(
            "cfx/CarFollowing-v0", num_envs=count, recording=PAIRS, driver=agent, followers=2
        )
        env.reset(seed=3, options={"pair": "p1"})
        return np.stack([env.step(np.full((count, 1), -0.3))[0] for _ in range(30)])

    np.testing.assert_allclose(run(4, AGENT)[:, 2], run(1, AGENT)[:, 0], rtol=0, atol=1e-5)
    assert (run(2, stochastic) == run(2, stochastic)).all()
    assert (run(2, stochastic)[:, 0] != run(2, stochastic)[:, 1]).any()


def test_the_reward_is_what_a_user_makes_of_the_outcome() -> None:
    def comfort(outcome: Outcome) -> NDArray[np.float64]:
        return -np.abs(outcome.jerk)

    env = CarFollowingVectorEnv(1, recording=straight_pairs([50]), reward=comfort)
    env.reset(seed=0)
    env.step(np.array([[1.0]]))
    assert env.step(np.array([[1.5]]))[1] == pytest.approx(-5.0)


def test_the_picture_has_every_vehicle() -> None:
    env = gymnasium.make(
        "cfx/CarFollowing-v0",
        recording=PAIRS,
        driver=AGENT,
        followers=2,
        render_mode="rgb_array",
    )
    env.reset(seed=0)
    picture = env.render()
    lane = np.unique(picture[30].reshape(-1, 3), axis=0)
    assert picture.dtype == np.uint8
    assert len(lane) == 4, "the road, the leader, the ego, who drives behind"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"followers": 2}, "need a driver"),
        ({"driver": AGENT, "followers": 0}, "a driver needs a vehicle"),
        ({"render_mode": "human"}, "give rgb_array"),
    ],
)
def test_arguments_that_contradict_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CarFollowingVectorEnv(1, recording=PAIRS, **arguments)  # type: ignore[arg-type]


def test_another_time_step_and_an_unknown_pair_are_refused() -> None:
    slow = PairSet(tuple(wavy_pairs(Krauss(), TRUE, frames=60)), "test")
    agent = adaptive({"name": "krauss"}, dt=0.2)
    with pytest.raises(DataError, match=r"steps of 0.1 s, the driver of 0.2 s"):
        CarFollowingVectorEnv(1, recording=slow, driver=agent)
    env = CarFollowingVectorEnv(1, recording=PAIRS)
    with pytest.raises(ConfigError, match="no pair 'p9'"):
        env.reset(options={"pair": "p9"})
