"""One environment of car following: that of E = 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np

from cfx.plugin import Agent
from cfx_drivers.gym.vector import Array, CarFollowingVectorEnv, Outcome, as_recorded, of_first


class CarFollowingEnv(gymnasium.Env[Array, Array]):
    """As `CarFollowingVectorEnv` (arguments, observation, action, reward), for one vehicle.

    `reset` begins an episode; its options are those there.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium's is of the instance
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        *,
        recording: Any = None,
        driver: str | Path | Agent | None = None,
        followers: int | None = None,
        reward: Callable[[Outcome], Array] = as_recorded,
        render_mode: str | None = None,
    ) -> None:
        self._one = CarFollowingVectorEnv(
            1,
            recording=recording,
            driver=driver,
            followers=followers,
            reward=reward,
            render_mode=render_mode,
        )
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self._one.metadata["render_fps"]}  # type: ignore[misc]
        self.observed = self._one.observed
        self.observation_space = self._one.single_observation_space
        self.action_space = self._one.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        observation, information = self._one.reset(
            seed=int(self.np_random.integers(2**31)), options=options
        )
        return observation[0], of_first(information)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, information = self._one.step(
            np.asarray(action)[None]
        )
        return (
            observation[0],
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            of_first(information),
        )

    def render(self) -> Array | None:
        pictures = self._one.render()
        return pictures[0] if pictures else None
