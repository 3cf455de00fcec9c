"""cfx's environments under Stable-Baselines3."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

import cfx_drivers.gym
from cfx.errors import ConfigError
from cfx.models.krauss import Krauss
from tests.drives import wavy_pairs

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="an extra of cfx-drivers")

gymnasium.register_envs(cfx_drivers.gym)
PAIRS = wavy_pairs(Krauss(), torch.tensor([[1.5, 0.1], [2.5, 0.4]]).double(), frames=30)


def environments(count: int = 3):  # type: ignore[no-untyped-def]  # of a library that may be absent
    from cfx_drivers.gym.stable_baselines import StableBaselinesEnv

    return StableBaselinesEnv(
        gymnasium.make_vec("cfx/CarFollowing-v0", num_envs=count, recording=PAIRS)
    )


def test_an_episode_begins_in_the_step_in_which_one_ends() -> None:
    """Its last observation is kept, and whether the recording ended there or the ego collided."""
    env = environments()
    env.seed(3)
    first = env.reset()
    assert first.shape == (3, 5)
    same = environments()
    same.seed(3)
    np.testing.assert_array_equal(same.reset(), first)
    for step in range(1, 30):
        observation, reward, over, infos = env.step(np.zeros((3, 1), dtype=np.float32))
        assert over.all() == (step == 29)
    assert reward.dtype == np.float32
    for number, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["time_s"] == pytest.approx(2.9)
        assert not np.array_equal(info["terminal_observation"], observation[number])
    observation, _, over, infos = env.step(np.zeros((3, 1), dtype=np.float32))
    assert not over.any()
    assert infos[0]["time_s"] == pytest.approx(0.1)


def test_an_agent_learns_in_it() -> None:
    agent = stable_baselines3.PPO(
        "MlpPolicy", environments(4), n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu"
    )
    agent.learn(128)
    assert agent.num_timesteps == 128


def test_other_environments_are_refused() -> None:
    from cfx_drivers.gym.stable_baselines import StableBaselinesEnv

    other = gymnasium.make_vec("CartPole-v1", num_envs=2)
    with pytest.raises(ConfigError, match="is no vector of cfx's environments"):
        StableBaselinesEnv(other)
