"""Car following for reinforcement learning: E environments, which step as one batch.

An agent accelerates the ego vehicle. It starts where a recorded follower started, behind their
recorded leader, and perhaps in front of drivers of cfx, who react to it.

Shapes: E environments, V = 1 + F vehicles of each (the ego and the drivers behind it), P pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

import cfx
from cfx.errors import ConfigError, DataError
from cfx.plugin import Agent, LimitSettings, Motion, PairBatch, PairSet, limited_speed, names
from cfx_drivers.gym.drawing import picture
from cfx_drivers.gym.drivers import driver_step

Array = NDArray[Any]

LENGTH_M = 5.0
"""Length of the ego vehicle and of the vehicles behind it."""

COLLISION = -100.0
"""Reward of a step in which the ego hits the vehicle ahead, or is hit."""

_OBSERVED = {
    "speed": (0.0, 100.0),
    "acceleration": (-20.0, 20.0),
    "gap": (-100.0, 10_000.0),
    "leader_speed": (0.0, 100.0),
    "leader_acceleration": (-20.0, 20.0),
}
_OBSERVED_BEHIND = {
    "follower_gap": (-100.0, 10_000.0),
    "follower_speed": (0.0, 100.0),
    "follower_acceleration": (-20.0, 20.0),
}


class Outcome(NamedTuple):
    """What a step of E environments led to; `(E,)` each, SI units.

    Attributes:
        speed, acceleration, jerk: of the ego vehicle.
        gap, leader_speed: of the vehicle ahead of it.
        recorded_speed: of the recorded follower at the same time.
        hardest_braking: the largest deceleration of the drivers behind; 0 without any.
        collided: whether the ego has hit the vehicle ahead or was hit, bool.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    gap: Array
    leader_speed: Array
    recorded_speed: Array
    hardest_braking: Array
    collided: Array


def as_recorded(outcome: Outcome) -> Array:
    """Returns rewards `(E,)`: minus the difference to the recorded speed (m/s), or -100."""
    difference = np.abs(outcome.speed - outcome.recorded_speed)
    return np.where(outcome.collided, COLLISION, -difference)


class CarFollowingVectorEnv(VectorEnv[Array, Array, Array]):
    """E environments of one recording, of which each episode is one pair from its first frame on.

    | observation | unit | of |
    | --- | --- | --- |
    | speed, acceleration | m/s, m/s2 | the ego vehicle |
    | gap | m | the vehicle ahead, bumper to bumper |
    | leader_speed, leader_acceleration | m/s, m/s2 | the vehicle ahead |
    | follower_gap, follower_speed, follower_acceleration | m, m/s, m/s2 | the next one behind |

    The action is the ego's acceleration, m/s2, within what a vehicle can do (-9 to 2.6); it does
    not drive backwards. An episode is terminated by a collision and truncated at the recording's
    end. After that the next `step` begins the next episode, whatever the action.

    Args:
        num_envs: E.
        recording: what `cfx.read` reads: a path, a data frame, pairs; None: synthetic drivers.
        driver: who drives behind the ego: a job's folder, `cfx://NAME` or an agent; None: nobody.
        followers: how many of them, one behind the other, F; None: one if there is a driver.
        reward: makes rewards `(E,)` of what a step led to; by default `as_recorded`.
        render_mode: `rgb_array`, or None.

    Raises:
        DataError: the recording or the driver cannot be read, or their time steps differ.
        ConfigError: an argument contradicts another.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # Gymnasium's is of the instance
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    _over: Tensor
    _acceleration: Tensor

    def __init__(
        self,
        num_envs: int = 1,
        *,
        recording: Any = None,
        driver: str | Path | Agent | None = None,
        followers: int | None = None,
        reward: Callable[[Outcome], Array] = as_recorded,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in {None, "rgb_array"}:
            raise ConfigError(f"render_mode={render_mode}: give rgb_array, or nothing")
        if followers is None:
            followers = 0 if driver is None else 1
        if (driver is None) != (followers == 0) or followers < 0:
            raise ConfigError(
                f"followers={followers}: vehicles behind the ego need a driver, such as"
                " driver='cfx://idm', and a driver needs a vehicle"
            )
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.pairs = _pairs(recording)
        self._batch = PairBatch.of(self.pairs)
        self.dt = self._batch.dt
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}  # type: ignore[misc]
        self._step = None if driver is None else driver_step(driver)
        if self._step is not None and abs(self._step.dt - self.dt) > 1e-6:
            raise DataError(
                f"the recording has steps of {self.dt:g} s, the driver of {self._step.dt:g} s;"
                f" read it with cfx.read(..., time_step={self._step.dt:g})"
            )
        self._followers, self._reward = followers, reward
        self._limits = LimitSettings()
        observed = {**_OBSERVED, **(_OBSERVED_BEHIND if followers else {})}
        self.observed = tuple(observed)
        low, high = np.array(list(observed.values()), dtype=np.float32).T
        self.single_observation_space = spaces.Box(low, high)
        self.single_action_space = spaces.Box(
            np.float32(-self._limits.emergency_deceleration),
            np.float32(self._limits.acceleration),
            (1,),
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begin_nothing()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begins an episode in every environment.

        Args:
            seed: of which pairs are drawn, and of what stochastic drivers leave to chance.
            options: `{"pair": ID}`: the pair of all environments; None: each draws one.

        Raises:
            ConfigError: there is no such pair.
        """
        super().reset(seed=seed)
        self._generator.manual_seed(int(self.np_random.integers(2**62)))
        everyone = torch.arange(self.num_envs)
        chosen = None if options is None else options.get("pair")
        if chosen is None:
            self._begin(everyone, self._drawn(self.num_envs))
        else:
            self._begin(everyone, torch.full((self.num_envs,), self._number(chosen)))
        return self._observation(), self._information(self._no_jerk())

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Takes one time step in every environment; one whose episode is over begins the next.

        Raises:
            DataError: an action is not a number.
        """
        wanted = torch.from_numpy(np.asarray(actions, dtype=np.float64)).view(self.num_envs)
        over = self._over.clone()
        unusable = (wanted.isnan() & ~over).nonzero().flatten().tolist()
        if unusable:
            low, high = -self._limits.emergency_deceleration, self._limits.acceleration
            raise DataError(
                f"the action of environment {unusable[0]} is not a number (NaN); give the ego's"
                f" acceleration, {low:g} to {high:g} m/s2"
            )
        before = self._acceleration[:, 0].clone()
        self._advance(wanted)
        outcome = self._outcome((self._acceleration[:, 0] - before) / self.dt)
        reward = np.asarray(self._reward(outcome), dtype=np.float64)
        terminated = outcome.collided.copy()
        truncated = (self._frame >= self._batch.lengths[self._pair] - 1).numpy() & ~terminated
        self._over = torch.from_numpy(terminated | truncated)
        if bool(over.any()):
            ended = over.numpy()
            reward[ended], terminated[ended], truncated[ended] = 0.0, False, False
            index = over.nonzero().flatten()
            self._begin(index, self._drawn(len(index)))
            outcome = self._outcome(torch.zeros_like(before))
        return (
            self._observation(),
            reward,
            terminated,
            truncated,
            self._information(outcome),
        )

    def begin_over(self) -> Array:
        """Begins the next episode at once where one is over; returns observations of all.

        For libraries that expect it in the step in which an episode ends.
        """
        index = self._over.nonzero().flatten()
        if len(index):
            self._begin(index, self._drawn(len(index)))
        return self._observation()

    def render(self) -> tuple[Array, ...]:
        """Returns a picture of each environment, `(H, W, 3)` uint8; none without a render mode."""
        if self.render_mode is None:
            return ()
        ahead, _, _ = self._leader()
        lengths = self._batch.leader_length[self._pair].tolist()
        of_followers = [LENGTH_M] * (1 + self._followers)
        pictures = []
        for front, length, behind in zip(
            ahead.tolist(), lengths, self._position.tolist(), strict=True
        ):
            pictures.append(picture([front, *behind], [length, *of_followers]))
        return tuple(pictures)

    def _begin_nothing(self) -> None:
        """Makes room for the state of all environments."""
        shape = (self.num_envs, 1 + self._followers)
        self._generator = torch.Generator()
        self._pair = torch.zeros(self.num_envs, dtype=torch.int64)
        self._frame = torch.zeros(self.num_envs, dtype=torch.int64)
        self._over = torch.zeros(self.num_envs, dtype=torch.bool)
        self._position = torch.zeros(shape, dtype=torch.float64)
        self._speed = torch.zeros(shape, dtype=torch.float64)
        self._acceleration = torch.zeros(shape, dtype=torch.float64)
        self._state = None
        if self._step is not None:
            self._state = self._step.begin(self.num_envs * self._followers)

    def _drawn(self, count: int) -> Tensor:
        """Draws pairs, `(count,)`."""
        return torch.from_numpy(self.np_random.integers(len(self.pairs), size=count))

    def _number(self, pair: object) -> int:
        for number, recorded in enumerate(self.pairs):
            if recorded.pair_id == names.name_of(pair):
                return number
        raise ConfigError(f"options: the recording has no pair '{pair}'")

    def _begin(self, environments: Tensor, pair: Tensor) -> None:
        """Begins episodes: all vehicles have the recorded follower's speed and gap."""
        batch = self._batch
        self._pair[environments], self._frame[environments] = pair, 0
        self._over[environments] = False
        position, speed = batch.follower_position[pair, 0], batch.follower_speed[pair, 0]
        gap = batch.leader_position[pair, 0] - batch.leader_length[pair] - position
        behind = torch.arange(1 + self._followers, dtype=torch.float64)
        self._position[environments] = position[:, None] - behind * (gap + LENGTH_M)[:, None]
        self._speed[environments] = speed[:, None].expand(-1, 1 + self._followers)
        self._acceleration[environments] = 0.0
        self._acceleration[environments, 0] = batch.follower_acceleration[pair, 0]
        if self._step is not None and self._state is not None:
            places = torch.arange(self._followers)
            drivers = (environments[:, None] * self._followers + places).flatten()
            self._state = self._state.with_drivers(drivers, self._step.begin(len(drivers)))

    def _leader(self) -> tuple[Tensor, Tensor, Tensor]:
        """Returns position (front), speed and acceleration of the recorded leaders, `(E,)`."""
        batch, at = self._batch, (self._pair, self._frame)
        return batch.leader_position[at], batch.leader_speed[at], batch.leader_acceleration[at]

    def _gaps(self) -> Tensor:
        """Returns the gap of every vehicle to the next ahead, `(E, V)`."""
        rear = self._leader()[0] - self._batch.leader_length[self._pair]
        ahead = torch.cat([rear[:, None], self._position[:, :-1] - LENGTH_M], 1)
        return ahead - self._position

    def _advance(self, wanted: Tensor) -> None:
        """Moves every vehicle by one step; all see the same instant."""
        speed = self._speed.clone()
        ego, last = self._speed[:, 0], self._acceleration[:, 0]
        target = (ego + wanted * self.dt).clamp(min=0.0)
        speed[:, 0] = limited_speed(self._limits, ego, last, target, self.dt)
        if self._step is not None and self._state is not None:
            noise = None
            if self._step.noise_width:
                shape = (self.num_envs * self._followers, self._step.noise_width)
                noise = torch.randn(shape, generator=self._generator, dtype=torch.float64)
            after, self._state = self._step(
                self._state,
                Motion(self._speed[:, 1:].flatten(), self._acceleration[:, 1:].flatten()),
                Motion(self._speed[:, :-1].flatten(), self._acceleration[:, :-1].flatten()),
                self._gaps()[:, 1:].flatten(),
                noise,
            )
            speed[:, 1:] = after.view(self.num_envs, -1)
        self._acceleration = (speed - self._speed) / self.dt
        self._position = self._position + speed * self.dt
        self._speed = speed
        last_frame = self._batch.lengths[self._pair] - 1
        self._frame = torch.minimum(self._frame + 1, last_frame)

    def _no_jerk(self) -> Outcome:
        return self._outcome(torch.zeros(self.num_envs, dtype=torch.float64))

    def _outcome(self, jerk: Tensor) -> Outcome:
        gaps = self._gaps()
        braking = torch.zeros(self.num_envs, dtype=torch.float64)
        if self._followers:
            braking = -self._acceleration[:, 1:].amin(1).clamp(max=0.0)
        at = (self._pair, self._frame)
        values = (
            self._speed[:, 0],
            self._acceleration[:, 0],
            jerk,
            gaps[:, 0],
            self._batch.leader_speed[at],
            self._batch.follower_speed[at],
            braking,
            (gaps[:, :2] < 0).any(1),
        )
        return Outcome(*(value.numpy() for value in values))

    def _observation(self) -> Array:
        _, leader_speed, leader_acceleration = self._leader()
        gaps = self._gaps()
        signals = [self._speed[:, 0], self._acceleration[:, 0], gaps[:, 0]]
        signals += [leader_speed, leader_acceleration]
        if self._followers:
            signals += [gaps[:, 1], self._speed[:, 1], self._acceleration[:, 1]]
        values = torch.stack(signals, 1).float().numpy()
        space = self.single_observation_space
        assert isinstance(space, spaces.Box)
        return values.clip(space.low, space.high)

    def _information(self, outcome: Outcome) -> dict[str, Any]:
        """Returns what Gymnasium calls info: arrays, and which of their entries count."""
        information: dict[str, Any] = {
            "pair": self._pair.numpy().copy(),
            "time_s": (self._frame.double() * self.dt).numpy(),
            "recorded_speed": outcome.recorded_speed,
            "hardest_braking": outcome.hardest_braking,
            "collided": outcome.collided,
        }
        everyone = np.ones(self.num_envs, dtype=bool)
        return {**information, **{f"_{name}": everyone for name in information}}


def of_first(information: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what is known of the first environment, as numbers."""
    return {
        name: value[0].item() for name, value in information.items() if not name.startswith("_")
    }


def _pairs(recording: Any) -> PairSet:
    """Returns the pairs of a recording.

    Raises:
        DataError: it cannot be read.
    """
    if isinstance(recording, PairSet):
        return recording
    if recording is None:
        return cfx.read(dataset="synthetic").selected
    selected = getattr(recording, "selected", None)  # of what cfx.read has read
    if isinstance(selected, PairSet):
        return selected
    return cfx.read(recording).selected
