"""Environments of cfx for Stable-Baselines3, whose vectors of environments are a class of its own.

    import gymnasium, cfx_drivers.gym
    from cfx_drivers.gym.stable_baselines import StableBaselinesEnv
    from stable_baselines3 import PPO

    environments = gymnasium.make_vec("cfx/CarFollowing-v0", num_envs=16)
    PPO("MlpPolicy", StableBaselinesEnv(environments)).learn(100_000)

Stable-Baselines3 is not among what cfx installs: `pip install stable-baselines3`.

A. Raffin et al. (2021), *Stable-Baselines3: Reliable Reinforcement Learning Implementations*,
Journal of Machine Learning Research 22(268).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from cfx.errors import ConfigError, NotInstalledError
from cfx_drivers.gym.vector import CarFollowingVectorEnv

try:
    # Not among what cfx installs for its checks.
    from stable_baselines3.common.vec_env import (  # type: ignore[import-not-found, unused-ignore]
        VecEnv,
    )
except ModuleNotFoundError as missing:
    raise NotInstalledError(
        "Stable-Baselines3 is not installed; its adapter needs it: pip install stable-baselines3"
    ) from missing


class StableBaselinesEnv(VecEnv):  # type: ignore[misc, unused-ignore]  # Any where it is absent
    """E environments as Stable-Baselines3 has them.

    An episode that is over begins anew in the same step: its last observation is
    `terminal_observation` of its info, and `TimeLimit.truncated` says whether the recording ended
    there.

    Args:
        environments: of `gymnasium.make_vec("cfx/CarFollowing-v0", ...)`, or a
            `CarFollowingVectorEnv`.

    Raises:
        ConfigError: they are other environments.
    """

    def __init__(self, environments: VectorEnv[Any, Any, Any]) -> None:
        inner = environments.unwrapped
        if not isinstance(inner, CarFollowingVectorEnv):
            raise ConfigError(
                f"{type(inner).__name__} is no vector of cfx's environments; give what"
                " gymnasium.make_vec('cfx/CarFollowing-v0', num_envs=...) returns"
            )
        self.environments = inner
        self._actions: NDArray[Any] = np.zeros((inner.num_envs, 1), dtype=np.float32)
        super().__init__(inner.num_envs, inner.single_observation_space, inner.single_action_space)
        self.render_mode = inner.render_mode

    def reset(self) -> NDArray[Any]:
        seeds = [seed for seed in self._seeds if seed is not None]
        seed = seeds[0] if seeds else None
        observation, information = self.environments.reset(seed=seed)
        self.reset_infos = self._each(information)
        self._reset_seeds()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        inner = self.environments
        observation, reward, terminated, truncated, information = inner.step(self._actions)
        over = terminated | truncated
        infos = self._each(information)
        if over.any():
            first = inner.begin_over()
            for number in over.nonzero()[0].tolist():
                infos[number]["terminal_observation"] = observation[number].copy()
                infos[number]["TimeLimit.truncated"] = bool(truncated[number])
            observation = np.where(over[:, None], first, observation)
        return observation, reward.astype(np.float32), over, infos

    def close(self) -> None:
        self.environments.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self.environments, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        # All environments are one object, which has an attribute once.
        setattr(self.environments, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        value = getattr(self.environments, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        return self.environments.render()

    def _each(self, information: dict[str, Any]) -> list[dict[str, Any]]:
        """Returns an info for each environment."""
        named = {name: each for name, each in information.items() if not name.startswith("_")}
        infos: list[dict[str, Any]] = []
        for number in range(self.num_envs):
            infos.append({name: each[number] for name, each in named.items()})
        return infos
